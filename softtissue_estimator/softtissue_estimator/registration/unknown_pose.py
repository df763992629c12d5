"""What distances along normals say about an organ whose pose is unknown too.

A small rigid motion moves a point p with normal n along it by n . (w x (p - c) + t): six columns, one row a point.
Without any prior on the motion, what observations say about everything else is what is left of them orthogonal to these
columns (the motion is integrated out), and the motion itself follows once the rest is known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion

FloatArray = NDArray[np.float64]


def rigid_columns(points: FloatArray, normals: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what rigid motions do along the normals, (n, 6).

    Parameters
    ----------
    points, normals
        (n, 3) m and (n, 3), at least six points.
    """
    centred, _ = _centred(points)
    basis: FloatArray = np.linalg.qr(np.concatenate([np.cross(centred, normals), normals], axis=1))[0]
    return basis


def rigid_step(points: FloatArray, normals: FloatArray, offsets: FloatArray) -> RigidMotion:
    """Return the small motion of points (n, 3) m that moves them by about `offsets` (n,) m along their normals."""
    centred, (centre, size) = _centred(points)
    columns = np.concatenate([np.cross(centred, normals), normals], axis=1)
    # What the surface leaves open, as a ball its turns, stays.
    solution = np.linalg.lstsq(columns, offsets, rcond=1e-8)[0]
    rotation = Rotation.from_rotvec(solution[:3] / size).as_matrix()
    return RigidMotion(rotation, centre + solution[3:] - rotation @ centre)


def after(first: RigidMotion, second: RigidMotion) -> RigidMotion:
    """Return the motion that makes one motion and then another."""
    return RigidMotion(
        second.rotation @ first.rotation, second.rotation @ first.translation + second.translation
    )


def _centred(points: FloatArray) -> tuple[FloatArray, tuple[FloatArray, float]]:
    """Points about their mean in units of their spread, so that turns and shifts are columns of one size."""
    centre = points.mean(axis=0)
    size = max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())), 1e-12)
    return (points - centre) / size, (centre, size)
