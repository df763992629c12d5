"""The frame of the rigid motion that fits what is observed, in which a network is left with what bends.

Most of how an organ moves is that it turns and shifts as a whole. A rigid motion y = R x + t is fitted to the observed
patches; in its frame a displacement u at x becomes R^T (x + u - t) - x. Lengths of differences are the same in both
frames. Attached tissue, which does not move, is displaced in this frame, by R^T (x - t) - x.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.observation.patch_average import ObservedPatches, average_groups, fit_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.surface_lookup import CELL_M, PATCH_CELLS

ORGAN, RIGID = "organ", "rigid"
FRAMES = (ORGAN, RIGID)
_PATCH_SIGMA_M = 0.0005  # what all points of a patch have in common: the fit hardly depends on it


def fit_frame(patches: ObservedPatches) -> RigidMotion:
    """Fit the rigid motion of observed patches, weighted by their inverse variances, with a prior against rotation."""
    return fit_patches(patches, _PATCH_SIGMA_M)


def fit_frame_of_points(reference: FloatArray, displacement: FloatArray, sigma_m: float) -> RigidMotion:
    """Do the same for points (n, 3) m with displacements (n, 3) m that are averaged in cubes of a patch's size."""
    cubes = np.floor((reference - reference.min(axis=0)) / (PATCH_CELLS * CELL_M)).astype(np.int64)
    size = cubes.max(axis=0) + 1
    _, patch = np.unique((cubes[:, 0] * size[1] + cubes[:, 1]) * size[2] + cubes[:, 2], return_inverse=True)
    spread = np.full(len(reference), sigma_m)
    return fit_frame(average_groups(patch, int(patch.max()) + 1, reference, displacement, spread))


def into_frame(motion: RigidMotion, points: FloatArray, displacement: FloatArray) -> FloatArray:
    """Displacements (n, 3) m at points (n, 3) m, seen from the frame: R^T (x + u - t) - x."""
    return motion.undo(points + displacement) - points


def out_of_frame(motion: RigidMotion, points: FloatArray, displacement: FloatArray) -> FloatArray:
    """Take displacements (n, 3) m at points (n, 3) m back to the organ's frame: R (x + u') + t - x."""
    return motion.apply(points + displacement) - points


def into_frames(rotation: Tensor, translation: Tensor, points: Tensor, displacement: Tensor) -> Tensor:
    """Do what `into_frame` does for many samples at once.

    Parameters
    ----------
    rotation, translation
        (B, 3, 3) and (B, 3) m.
    points, displacement
        (B, ..., 3) m; displacement may have fewer dimensions, such as ().
    """
    moved = (points + displacement).flatten(1, -2) - translation[:, None]
    return torch.bmm(moved, rotation).reshape(points.shape) - points
