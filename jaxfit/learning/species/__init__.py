"""Adaptation of a model to a species; comparison and rigging of models."""
