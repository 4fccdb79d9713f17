"""Files of observations: readers and writers."""
