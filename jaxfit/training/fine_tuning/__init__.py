"""Training of a network on labelled footage, from the weights of another network."""
