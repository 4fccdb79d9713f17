"""Training of networks, on simulated footage and on labels."""
