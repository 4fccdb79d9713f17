"""File formats of SLEAP."""
