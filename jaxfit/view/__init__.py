"""Drawings of results: overlays, contact sheets, views of a model."""
