"""Training of the built-in networks on simulated footage alone. Needs the extra `train` (PyTorch)."""
