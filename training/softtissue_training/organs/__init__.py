"""Random organs: surfaces, the tetrahedra inside them, and patches of them."""
