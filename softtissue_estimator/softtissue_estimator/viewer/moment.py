"""What the page draws at a moment, all in the organ's frame."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Singles = NDArray[np.float32]
Level = Literal["OK", "DEGRADED", "INVALID", "NO ESTIMATE"]


@dataclass(frozen=True, eq=False)
class Observed:
    """Points of a cloud, thinned.

    Attributes
    ----------
    stamp_ns : int
    frame : str
    points : (n, 3) float32
        Finite, m, in `frame`.
    left_out : (n,) bool
        Points that are found, or said by the cloud itself, not to be of the organ.
    """

    stamp_ns: int
    frame: str
    points: Singles
    left_out: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Health:
    """What the status says.

    Attributes
    ----------
    level : str
        "OK", "DEGRADED" or "INVALID".
    reason : str
    latency_s : float
        From the reception of the cloud to its answer; NaN where there is none.
    visible_fraction : float
        Share of the organ's surface that was seen, 0 to 1; NaN where there is none.
    points_used, points_rejected : int
    outlier_fraction : float
        Share of the used points that got no weight; NaN where the estimator does not tell.
    about : tuple of str
        Organ, estimator, what clouds are matched by, where the registration comes from.
    """

    level: Level
    reason: str = ""
    latency_s: float = float("nan")
    visible_fraction: float = float("nan")
    points_used: int = 0
    points_rejected: int = 0
    outlier_fraction: float = float("nan")
    about: tuple[str, str, str, str] = ("", "", "", "")


@dataclass(frozen=True, eq=False)
class ToolDistances:
    """How far a tool's tip is from the structures.

    Attributes
    ----------
    frame : str
        Of `nearest`.
    names, kinds : tuple of str
    distance, sigma : (s,) float64
        m; negative inside of a structure; NaN where not known.
    nearest : (s, 3) float64
        Nearest point of each structure, m.
    """

    frame: str
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    distance: FloatArray
    sigma: FloatArray
    nearest: FloatArray


@dataclass(frozen=True)
class Lens:
    """How much a camera sees.

    Attributes
    ----------
    height_rad : float
        Angle from the upper to the lower edge of its image.
    aspect : float
        Width of the image over its height.
    """

    height_rad: float = 1.0
    aspect: float = 4.0 / 3.0


@dataclass(frozen=True, eq=False)
class CameraImage:
    """An image of a camera, made small.

    Attributes
    ----------
    frame : str
    pixels : (rows, columns, 3) uint8
        Red, green and blue.
    lens : Lens
    """

    frame: str
    pixels: NDArray[np.uint8]
    lens: Lens


@dataclass(frozen=True, eq=False)
class Moment:
    """An answer and what belongs to it, organ's frame, m.

    Attributes
    ----------
    time_s : float
        When it arrived, by a clock that never goes back.
    stamp_ns : int
        Of the cloud that is answered.
    points : (n, 3) float32
        Vertices of all structures.
    sigma : (s,) float64
        Largest standard deviation of each structure; NaN where none is known.
    surface : (k, 3) float32 or None
        Vertices of the organ's surface.
    observed : (m, 3) float32
    left_out : (m,) bool
    camera : (4, 4) float64 or None
        Pose of the clouds' frame; None where clouds come in the organ's frame or no pose was told.
    camera_frame : str
        Name of that frame.
    level, reason : str
        What the status said.
    judged : bool
        Whether `left_out` are those that the answer does not rely on.
    """

    time_s: float
    stamp_ns: int
    points: Singles
    sigma: FloatArray
    surface: Singles | None
    observed: Singles
    left_out: NDArray[np.bool_]
    camera: FloatArray | None
    camera_frame: str = ""
    level: Level = "OK"
    reason: str = ""
    judged: bool = False

    @property
    def size(self) -> int:
        """Bytes of its arrays."""
        arrays = (self.points, self.sigma, self.surface, self.observed, self.left_out, self.camera)
        return sum(array.nbytes for array in arrays if array is not None)
