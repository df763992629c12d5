"""Training of the hybrid network on what the elastic posterior leaves."""
