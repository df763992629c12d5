"""An organ's surface as the search for a pose needs it: samples, the nearest one of any place, and a coarse field."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, unit_rows

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SAMPLES = 1600
"""Of an organ's surface."""
_CELL_M = 0.005  # of the table of nearest samples
_MARGIN_M = 0.045  # around the organ, that the table covers
_FIELD_REACH_M = 0.025  # from the surface, within which normals attract normals
_FIELD_MARGIN_M = 0.030
_SKIN_M = 0.008  # what lies so deep is inside although the organ is deformed,
_DEEP_M = 0.020  # and counts in full from here on


class PoseSurface:
    """Points spread evenly over a surface.

    Parameters
    ----------
    surface
        At rest, organ's frame, m, facing outwards.

    Attributes
    ----------
    points, normals
        (s, 3) m and (s, 3).
    area
        That each sample stands for, m^2.
    centre
        (3,) m, mean vertex, as `Organ.centre`.
    """

    def __init__(self, surface: SurfaceMesh) -> None:
        self.points, self.normals = surface_samples(surface)
        self.area = float(face_areas(surface).sum()) / SAMPLES
        self.centre: FloatArray = surface.vertices.mean(axis=0)
        self._tree = cKDTree(self.points)
        self._low, self._shape, places = _lattice(self.points, _MARGIN_M, _CELL_M)
        self._nearest = np.asarray(self._tree.query(places)[1], dtype=np.int32)

    @property
    def few(self) -> FloatArray:
        """Some of the points, (n, 3) m, enough to tell poses apart."""
        return self.points[::16]

    def nearest(self, points: FloatArray) -> tuple[IntArray, BoolArray]:
        """Return the sample nearest to points (..., 3) m, as the table has it, and whether any is near, (...,)."""
        cell = np.rint((points - self._low) / _CELL_M).astype(np.int64)
        inside = ((cell >= 0) & (cell < self._shape)).all(axis=-1)
        cell = np.clip(cell, 0, self._shape - 1)
        flat = (cell[..., 0] * self._shape[1] + cell[..., 1]) * self._shape[2] + cell[..., 2]
        return self._nearest[flat].astype(np.int64), np.asarray(inside)

    def field(self, cell_m: float) -> tuple[FloatArray, FloatArray]:
        """Return a field on a lattice and where the lattice begins.

        Returns
        -------
        field
            (4, x, y, z) float32: outward normals near the surface, fading with the distance, and how deep inside a
            place is, 0 to 1.
        low
            (3,) m.
        """
        low, shape, places = _lattice(self.points, _FIELD_MARGIN_M, cell_m)
        distance, sample = self._tree.query(places)
        fading = np.maximum(0.0, 1.0 - distance / _FIELD_REACH_M)
        height = np.einsum("nd,nd->n", places - self.points[sample], self.normals[sample])
        deep = (height < -_SKIN_M) * np.minimum(1.0, distance / _DEEP_M)
        values = np.column_stack([self.normals[sample] * fading[:, None], deep])
        return values.T.reshape(4, *shape).astype(np.float32), low


def surface_samples(surface: SurfaceMesh) -> tuple[FloatArray, FloatArray]:
    """Return points (s, 3) m spread evenly over a surface, and its normals there, always the same ones."""
    rng = np.random.default_rng(0)
    until = np.cumsum(face_areas(surface))
    # One sample in each of equal shares of the area.
    drawn = (np.arange(SAMPLES) + rng.random(SAMPLES)) / SAMPLES * until[-1]
    face = np.minimum(np.searchsorted(until, drawn), len(until) - 1)
    corner = np.asarray(igl.per_vertex_normals(surface.vertices, surface.faces))
    weights = rng.dirichlet([1.0, 1.0, 1.0], SAMPLES)
    points = np.einsum("nc,ncd->nd", weights, surface.triangles[face])
    return points, unit_rows(np.einsum("nc,ncd->nd", weights, corner[surface.faces[face]]))


def _lattice(points: FloatArray, margin_m: float, cell_m: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """Lower corner (3,) m, shape (3,) and places (n, 3) m of a lattice around points."""
    low = points.min(axis=0) - margin_m
    shape = np.ceil((points.max(axis=0) + margin_m - low) / cell_m).astype(np.int64) + 1
    axes = [low[axis] + cell_m * np.arange(shape[axis]) for axis in range(3)]
    return low, shape, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
