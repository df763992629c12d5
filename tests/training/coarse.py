"""What the small simulations of the tests are made with."""

import numpy as np

from softtissue_training.simulation.recipe import Recipe

COARSE = Recipe(element_size_m=0.02)
LINEAR = np.array([[0.1, 0.2, -0.1], [0.05, -0.1, 0.3], [-0.2, 0.1, 0.15]])
