"""File formats of observations: readers and writers."""
