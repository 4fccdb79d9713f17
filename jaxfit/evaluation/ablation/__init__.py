"""Ablations: every config of a grid is fitted to the same birds, measured and reported."""
