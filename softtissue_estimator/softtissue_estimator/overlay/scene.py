"""What is drawn on an image: where the structures of an organ are at a moment."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Order = Literal["rgb", "bgr"]
"""Of an image's channels."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Where the structures are, in the camera's frame.

    Attributes
    ----------
    points : (n, 3) float64
        Vertices of all structures, m.
    sigma : (n,) float64
        Standard deviation of each component, m; NaN where none is known.
    surface : (k, 3) float64 or None
        Vertices of the organ's surface, m, where they are known.
    """

    points: FloatArray
    sigma: FloatArray
    surface: FloatArray | None = None
