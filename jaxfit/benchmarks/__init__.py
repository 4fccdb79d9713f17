"""Measurements of speed and quality on the machine at hand, for `jaxfit bench` and `make bench`."""
