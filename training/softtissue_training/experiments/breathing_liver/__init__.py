"""A breathing liver of our own, with the truth everywhere: simulated, scanned twice, written as a user's case."""
