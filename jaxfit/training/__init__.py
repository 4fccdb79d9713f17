"""Training of networks, on simulated footage and on labels of a user. It needs the extra `train` (PyTorch)."""
