"""Training of the built-in networks on simulated footage only. It needs the extra `train` (PyTorch)."""
