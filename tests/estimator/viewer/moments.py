"""A small organ, and moments of it."""

import numpy as np

from softtissue_estimator.view.structures import make_structures
from softtissue_estimator.viewer.moment import Moment

S = 1_000_000_000
POINTS = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.03, 0.0, 0.0], [0.04, 0.0, 0.01]])
SURFACE = np.array([[-0.1, -0.1, -0.1], [0.1, -0.1, -0.1], [0.0, 0.1, -0.1], [0.0, 0.0, 0.1]])
SURFACE_FACES = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
SIGMA = np.array([0.001, 0.003, 0.002, np.nan, np.nan])


def organ():
    """Structures: a vein of three vertices and a tumour of two, without a triangle."""
    return make_structures(
        ("vein", "tumour <b>"),
        ("vessel", "tumour"),
        np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 0.0]]),
        np.array([0, 3, 5]),
        np.array([0, 1, 1]),
        np.array([[0, 1, 2]], dtype=np.int32),
        SURFACE_FACES,
    )


def moment(time_s, shift=0.0, surface=True):
    return Moment(
        time_s,
        int(time_s * S),
        (POINTS + np.array([shift, 0.0, 0.0])).astype(np.float32),
        np.array([0.003, np.nan]),
        SURFACE.astype(np.float32) if surface else None,
        np.zeros((0, 3), np.float32),
        np.zeros(0, bool),
        None,
    )
