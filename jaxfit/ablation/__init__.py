"""Ablations: a grid of configs crossed, fitted in batches, measured and reported."""
