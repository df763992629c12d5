"""Small simulations of the tests, and what they are made with."""

import dataclasses
import functools

import numpy as np

from softtissue_training.evaluation.streams.stream import StreamSettings
from softtissue_training.simulation.moving_organ import MotionSettings
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.sample import Record
from softtissue_training.simulation.simulate import simulate

COARSE = Recipe(element_size_m=0.02)
COARSE_MOTION = MotionSettings(dataclasses.replace(MotionSettings().recipe, element_size_m=0.02), states=11)
COARSE_STREAM = StreamSettings(frames=20, interval_s=0.5, spacing_m=0.004)
LINEAR = np.array([[0.1, 0.2, -0.1], [0.05, -0.1, 0.3], [-0.2, 0.1, 0.15]])


@functools.cache
def coarse_records() -> tuple[Record, ...]:
    """Six organs with coarse elements, one load case each."""
    return tuple(simulate(3, number, COARSE) for number in range(6))
