"""Evaluation: metrics of results and of observations against the truth."""
