"""The in-silico benchmark: reserved simulations, fixed conditions, every estimator on the same samples."""
