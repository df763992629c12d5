"""A body in which no two poses look alike, for registration."""

import numpy as np
import trimesh

from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces


def make_lump() -> SurfaceMesh:
    """An ellipsoid of 80 x 55 x 35 mm half-axes with bumps."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    unit = np.asarray(sphere.vertices)
    bumps = np.array([[1.0, 0.4, 0.2], [-0.2, 0.9, 0.5], [0.3, -0.6, 0.8]])
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    radius = 1.0 + (np.exp((unit @ bumps.T - 1.0) / 0.08) * [0.35, 0.25, 0.3]).sum(axis=1)
    return SurfaceMesh(unit * radius[:, None] * [0.080, 0.055, 0.035], np.asarray(sphere.faces))


def part_of(lump: SurfaceMesh) -> np.ndarray:
    """Points (n, 3) m all over a third of the lump."""
    middle = lump.triangles.mean(axis=1)
    return sample_faces(lump, middle @ [0.3, 0.7, 0.6] > 0.018, 0.004)[0]
