"""Benchmarks of speed and quality on the current machine, for `jaxfit bench` and `make bench`."""
