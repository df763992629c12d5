"""What gives away that an organ's files are in another unit or coordinate system than they should be."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import igl
import numpy as np

from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.mesh import FloatArray, SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.support.yaml_file import shown

# From a rat's liver to twice the largest spleen or liver on record. A unit that is wrong by a factor of ten is wrong
# by a thousand in volume, and this spans two thousand.
_SMALLEST_LITRES, _LARGEST_LITRES = 0.01, 20.0
_LONGEST_M = 1.0
_STRUCTURE_MARGIN_SHARE = 0.1  # of the diagonal of the organ's bounding box
# Largest extent of a structure over the organ's: a lesion of a millimetre has 0.004, anything in metres that is taken
# for millimetres at most 0.002.
_SMALLEST_STRUCTURE_RATIO, _LARGEST_STRUCTURE_RATIO = 0.002, 10.0
_LEAST_SHARE_INSIDE = 0.3  # of a structure's points, from which on its place needs no further check
_LANDMARK_REACH_M = 0.010  # from the surface: they are set by hand on pictures
_CHECKED_POINTS = 1000  # of a structure

_log = logging.getLogger(__name__)


def check_size(surface: SurfaceMesh, path: Path, unit: str, unit_m: float) -> None:
    """Raise OrganError if no organ is that large or that small, and say which unit would fit.

    Parameters
    ----------
    surface : SurfaceMesh
        m.
    path : Path
        Of `organ.yaml`, for messages.
    unit, unit_m : str, float
        The unit that it states, 'mm' or 'm', and its length, m.
    """
    litres = 1e3 * enclosed_volume(surface)
    lengths = np.ptp(surface.vertices, axis=0)
    if _SMALLEST_LITRES <= litres <= _LARGEST_LITRES and lengths.max() <= _LONGEST_M:
        return
    size = " x ".join(f"{length:.3g}" for length in lengths)
    hint = _unit_hint(litres, float(lengths.max()), unit, unit_m)
    raise OrganError(
        f"{path}: expected an organ of {_SMALLEST_LITRES:g} to {_LARGEST_LITRES:g} litres and at most "
        f"{_LONGEST_M:g} m, got {litres:.3g} litres ({size} m) with unit {unit}{hint}"
    )


def _unit_hint(litres: float, longest_m: float, unit: str, unit_m: float) -> str:
    for other, other_m in (("mm", 0.001), ("m", 1.0), ("cm", 0.01)):
        scale = other_m / unit_m
        fits = _SMALLEST_LITRES <= litres * scale**3 <= _LARGEST_LITRES and longest_m * scale <= _LONGEST_M
        if other == unit or not fits:
            continue
        probably = f"; the unit is probably wrong, in {other} it would be {litres * scale**3:.3g} litres"
        return probably + (": scale the files by 10 and state mm" if other == "cm" else f": state {other}")
    return ""


def check_place(name: str, structure: SurfaceMesh, surface: SurfaceMesh, path: Path) -> None:
    """Raise OrganError if a structure cannot be inside the organ, warn if most of it is outside.

    Parameters
    ----------
    name : str
        What the structure is called.
    structure, surface : SurfaceMesh
        m, in one frame.
    path : Path
        Of `organ.yaml`, for messages.
    """
    where = f"{path}, structure {name!r}"
    ratio = float(np.ptp(structure.vertices, axis=0).max() / np.ptp(surface.vertices, axis=0).max())
    if not _SMALLEST_STRUCTURE_RATIO <= ratio <= _LARGEST_STRUCTURE_RATIO:
        raise OrganError(
            f"{where}: expected a mesh in the unit of the organ's, got one {ratio:.2g} times as long as the organ; "
            "save it in the same unit"
        )
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    margin = _STRUCTURE_MARGIN_SHARE * float(np.linalg.norm(high - low))
    points = structure.vertices[:: max(1, len(structure.vertices) // _CHECKED_POINTS)]
    share = share_inside(surface, points)
    if share >= _LEAST_SHARE_INSIDE:
        return
    gap = float(distance_to_box(structure.vertices, low, high).min())
    hint = mirror_hint(surface, points, share)
    if gap > margin:
        raise OrganError(
            f"{where}: expected it inside the organ, got it {1e3 * gap:.0f} mm away from the organ's bounding box{hint}"
        )
    if hint:
        raise OrganError(
            f"{where}: expected it inside the organ, got {100.0 * share:.0f} % of it inside{hint}"
        )
    _log.warning("%s: only %.0f %% of it lies inside the organ", where, 100.0 * share)


def check_landmarks(
    landmarks: Mapping[str, tuple[float, float, float]], surface: SurfaceMesh, path: Path
) -> dict[str, FloatArray]:
    """Return landmarks, (3,) m each, or raise OrganError if one is not on the surface.

    Parameters
    ----------
    landmarks : mapping
        m, as `organ.yaml` has them.
    surface : SurfaceMesh
        m.
    path : Path
        Of `organ.yaml`, for messages.
    """
    if not landmarks:
        return {}
    places = np.array(list(landmarks.values()))
    distance = _distance(surface, places)
    far = int(np.argmax(distance))
    if distance[far] > _LANDMARK_REACH_M:
        turned = _distance(surface, places * [-1.0, -1.0, 1.0])
        hint = "; with x and y negated all are, so one file is in LPS and the other in RAS"
        raise OrganError(
            f"{path}, landmarks, {shown(list(landmarks)[far])}: expected a place within "
            f"{1e3 * _LANDMARK_REACH_M:g} mm of the surface, got one {1e3 * distance[far]:.0f} mm away"
            f"{hint if turned.max() <= _LANDMARK_REACH_M else ''}"
        )
    return dict(zip(landmarks, places, strict=True))


def _distance(surface: SurfaceMesh, points: FloatArray) -> FloatArray:
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)[0]
    return np.sqrt(np.maximum(np.asarray(squared, dtype=np.float64), 0.0))


def mirror_hint(surface: SurfaceMesh, points: FloatArray, share: float) -> str:
    """Say that (n, 3) points (m) are in the other one of LPS and RAS if that brings far more of them inside."""
    if share_inside(surface, points * [-1.0, -1.0, 1.0]) < share + 0.5:
        return ""
    return "; with x and y negated it lies inside, so one of the files is in LPS and the other in RAS"


def share_inside(surface: SurfaceMesh, points: FloatArray) -> float:
    """Share of (n, 3) points (m) inside the surface."""
    return float((signed_distance(surface, points) <= 0.0).mean())


def distance_to_box(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Distance of (n, 3) points from a box, zero inside, (n,)."""
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    distance: FloatArray = np.linalg.norm(outside, axis=1)
    return distance
