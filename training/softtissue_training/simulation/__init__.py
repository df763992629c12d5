"""Simulations: what they are drawn from, how they are made, and how they are stored."""
