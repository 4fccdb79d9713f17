"""What is learnt from data: priors, species, networks (extra `train`)."""
