"""Simulation of soft-tissue deformation and training of the estimator's network."""
