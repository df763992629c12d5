"""How an organ bends most easily, as its elasticity says: what the search for its pose supposes of its deformation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.estimators.estimator import Estimator
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.registration.pose_surface import surface_samples
from softtissue_estimator.registration.smooth_bending import leading_modes
from softtissue_estimator.registration.unknown_pose import rigid_columns

FloatArray = NDArray[np.float64]

COUNT = 40
_LEAST_BENDING = 1e-4  # of what loads do along the normals that is not rigid; less is rounding


def elastic_modes(estimator: Estimator, surface: SurfaceMesh) -> NDArray[np.float32] | None:
    """Return the leading modes of what loads all over an organ do to its surface beside moving it rigidly.

    Suppositions about what holds the organ (`Estimator.compliances`) have equal shares: the search is sure of a wrong
    pose more often where it believes in one of them.

    Parameters
    ----------
    estimator
        Has the organ loaded.
    surface
        Of that organ at rest, organ's frame, m.

    Returns
    -------
    (s, m) along the normals at `surface_samples`, orthogonal, the largest first, whose squares add up to 1 on average
    over the samples; None if the estimator has no elastic model.
    """
    points, normals = surface_samples(surface)
    rigid = rigid_columns(points, normals)  # the pose is searched for anyway
    bent = [_bent(one.astype(np.float64), rigid) for one in estimator.compliances(points, normals)]
    found = [_of_size_one(leading_modes(one, 2 * COUNT)) for one in bent if one is not None]
    if not found:
        return None
    return np.asarray(_of_size_one(leading_modes(np.concatenate(found, axis=1), COUNT)), dtype=np.float32)


def _bent(moved: FloatArray, rigid: FloatArray) -> FloatArray | None:
    """Return what displacements (s, p) do beside rigid ones; None where that is nothing."""
    bent = moved - rigid @ (rigid.T @ moved)
    return bent if np.linalg.norm(bent) > _LEAST_BENDING * np.linalg.norm(moved) else None


def _of_size_one(modes: FloatArray) -> FloatArray:
    return np.asarray(modes / np.sqrt((modes**2).sum(axis=1).mean()))
