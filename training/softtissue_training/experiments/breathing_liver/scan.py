"""Surfaces as a scan and its segmentation would give them: sampled anew, and a little off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, label, map_coordinates, spline_filter

from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.phantom.isosurface import isosurface

FloatArray = NDArray[np.float64]

_VOXELS_PER_EDGE = 2.0
_MARGIN_VOXELS = 4  # beside the surface
_EXACT_VOXELS = 4.0


def segment(
    mesh: SurfaceMesh, spacing_m: float, error_m: float, length_m: float, rng: np.random.Generator
) -> SurfaceMesh:
    """Return the surface that a segmentation finds of a body, with triangles of its own.

    The signed distance is sampled on voxels of half the target edge length; an error is added that is normally
    distributed at every place and changes smoothly.

    Parameters
    ----------
    mesh
        True surface, m; closed.
    spacing_m
        Target edge length, m.
    error_m
        Standard deviation of the error, m.
    length_m
        Over which the error changes (standard deviation of the Gaussian that smooths it), m.

    Raises
    ------
    MeshError
        If no closed surface is found.
    """
    voxel = spacing_m / _VOXELS_PER_EDGE
    lower = mesh.vertices.min(axis=0) - _MARGIN_VOXELS * voxel
    shape = np.ceil((np.ptp(mesh.vertices, axis=0)) / voxel).astype(int) + 2 * _MARGIN_VOXELS + 1
    values = _sampled_distance(mesh, lower, tuple(shape), voxel)
    values = values + error_m * _smooth_noise(tuple(shape), length_m / voxel, rng)
    coefficients = spline_filter(values, mode="nearest")

    def function(points: FloatArray) -> FloatArray:
        index = (points - lower).T / voxel
        return np.asarray(map_coordinates(coefficients, index, mode="nearest", prefilter=False))

    upper = lower + voxel * (shape - 1)
    # Splines ring beyond the outermost voxels.
    return isosurface(function, lower + voxel, upper - voxel, spacing_m, rounds=8)


def _sampled_distance(
    mesh: SurfaceMesh, lower: FloatArray, shape: tuple[int, ...], voxel: float
) -> FloatArray:
    """Signed distance (m) at the centres of voxels: exact near the surface, to a voxel's size further away.

    Most voxels around a tree are far from it, and a spline near the surface hardly feels them.
    """
    samples = sample_faces(mesh, None, 0.5 * voxel)[0]
    on_surface = np.zeros(shape, dtype=bool)
    on_surface[tuple(np.rint((samples - lower) / voxel).astype(np.int64).T)] = True
    distance = np.asarray(distance_transform_edt(~on_surface, sampling=voxel))
    parts, _ = label(distance > voxel)
    values = np.where(parts == parts[0, 0, 0], distance, -distance)
    near = distance <= _EXACT_VOXELS * voxel
    values[near] = signed_distance(mesh, lower + voxel * np.argwhere(near))
    return values


def _smooth_noise(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> FloatArray:
    """Gaussian noise of unit standard deviation, smoothed by a Gaussian of `sigma` voxels."""
    white = rng.normal(size=shape)
    smooth = np.asarray(gaussian_filter(white, sigma, mode="wrap"))
    # The variance that smoothing leaves of white noise.
    return np.asarray(smooth * (2.0 * np.sqrt(np.pi) * sigma) ** 1.5)
