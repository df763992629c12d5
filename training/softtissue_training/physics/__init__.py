"""Static equilibrium of hyperelastic bodies of four-node tetrahedra."""
