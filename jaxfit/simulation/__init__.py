"""Scenes with known truth: smooth random motion, and what a detector would report of it."""
