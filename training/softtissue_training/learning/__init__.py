"""Training of the network on simulations."""
