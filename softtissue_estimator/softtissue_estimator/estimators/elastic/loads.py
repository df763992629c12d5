"""The loads that may push an organ, its traction basis: smooth patches all over its surface, and its own weight.

Whatever pushes is a sum of these, each with an amplitude (a vector); `linear_gaussian` finds the amplitudes.
"""

import numpy as np

from softtissue_estimator.estimators.elastic.elasticity import nodal_areas, nodal_volumes
from softtissue_estimator.organ.farthest_points import farthest_points
from softtissue_estimator.organ.mesh import FloatArray, IntArray
from softtissue_estimator.organ.volume_mesh import VolumeMesh

PATCH_SPACING_M = 0.012
SIZES = (1.0, 2.0)
"""Of patches, over the finest. What pushes is as small as an instrument or as large as a hand. Were all patches fine,
relevance determination would make a wide push narrow, and what lies under it would move too far."""
PATCH_WIDTH_RATIO = 11.0 / 12.0  # standard deviation of a patch over the spacing
MOST_PATCHES = 240  # on a larger organ they are spread wider
_LEAST_RELATIVE_WEIGHT = 1e-9
"""Of a patch's middle. What is farther out is cut off: in single precision it would become denormal numbers, with which
processors compute a hundred times as slowly."""
_LEAST_FREE_SHARE = 0.15  # of a patch, that must not be attached
_LEAST_HELD_SHARE = 0.03  # of the largest area of a node: what is held by less moves nothing


def load_basis(mesh: VolumeMesh, attached_areas: FloatArray | None = None) -> FloatArray:
    """Nodal forces of the traction basis: unit loads, (n, p); each column sums to one.

    Gaussian patches of each of the `SIZES` about points of the surface that are spread evenly, at most `MOST_PATCHES`
    of a size, and last the weight of the organ. Nothing pushes where the organ is attached.

    Parameters
    ----------
    mesh : VolumeMesh
    attached_areas : (n,) m^2
        Attached surface that belongs to each node; none by default.
    """
    areas = nodal_areas(mesh)
    surface = np.flatnonzero(areas > 0.0)
    weight = _patches(mesh.nodes[surface])
    patches = np.zeros((len(mesh.nodes), weight.shape[1]))
    patches[surface] = weight * areas[surface, None]
    whole = patches.sum(axis=0)
    if attached_areas is not None:
        patches *= (1.0 - attached_areas / np.maximum(areas, 1e-12)).clip(0.0, 1.0)[:, None]
    free = patches.sum(axis=0)
    kept = free > _LEAST_FREE_SHARE * whole
    volumes = nodal_volumes(mesh)
    return np.ascontiguousarray(np.column_stack([patches[:, kept] / free[kept], volumes / volumes.sum()]))


def attachment_basis(mesh: VolumeMesh, springs: FloatArray, attached_areas: FloatArray) -> FloatArray:
    """Nodal forces of the springs where what they are fixed to moves by one metre, (n, q); none where nothing is held.

    It moves in patches as wide as the largest that push, as a whole, and in proportion to each coordinate: a turn or a
    stretch of all that holds the organ is one of few explanations, not a sum of many.

    Parameters
    ----------
    mesh : VolumeMesh
    springs : (n, n) 1/m
        Over Young's modulus.
    attached_areas : (n,) m^2
        Attached surface that belongs to each node.
    """
    held = np.flatnonzero(attached_areas > _LEAST_HELD_SHARE * nodal_areas(mesh).max())
    if not len(held):
        return np.zeros((len(mesh.nodes), 0))
    points = mesh.nodes[held]
    centres, apart = _spread(points, SIZES[-1] * PATCH_SPACING_M)
    weight = _gaussians(points, centres, apart)
    moved = np.zeros((len(mesh.nodes), len(centres)))
    moved[held] = weight / weight.sum(axis=1, keepdims=True)
    along = mesh.nodes - points.mean(axis=0)
    along /= np.sqrt((along[held] ** 2).sum(axis=1).mean()) + PATCH_SPACING_M
    return np.asarray(springs @ np.column_stack([moved, np.ones(len(along)), along]))


def _patches(points: FloatArray) -> FloatArray:
    """Weights (n, k) of points of the surface (n, 3) m in each patch, 1 in its middle."""
    sizes = []
    spacing = PATCH_SPACING_M
    for size in SIZES:
        centres, apart = _spread(points, size * spacing)
        spacing = max(spacing, apart / size)  # of a large organ
        sizes.append(_gaussians(points, centres, size * spacing))
    return np.concatenate(sizes, axis=1)


def _gaussians(points: FloatArray, centres: IntArray, spacing: float) -> FloatArray:
    squared = ((points[:, None] - points[centres]) ** 2).sum(axis=2)
    weight = np.exp(-squared / (2.0 * (PATCH_WIDTH_RATIO * spacing) ** 2))
    weight[weight < _LEAST_RELATIVE_WEIGHT] = 0.0
    return np.asarray(weight)


def _spread(points: FloatArray, spacing: float) -> tuple[IntArray, float]:
    """Choose points (n, 3) m that are spread over all; and how far apart they are at least, m."""
    first = int(np.square(points - points.mean(axis=0)).sum(axis=1).argmax())
    centres, left = farthest_points(points, MOST_PATCHES, first, spacing)
    return centres, max(spacing, left)
