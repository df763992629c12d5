"""Signed distance against spheres and boxes whose distance is known exactly."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.signed_distance import signed_distance


def _surface(mesh: trimesh.Trimesh) -> SurfaceMesh:
    return SurfaceMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def test_box_inside_and_outside() -> None:
    half = np.array([0.05, 0.03, 0.08])
    points = np.random.default_rng(1).uniform(-0.15, 0.15, (2000, 3))
    got = signed_distance(_surface(trimesh.creation.box(2 * half)), points)
    expected = _box_distance(points, half)
    assert (expected < 0).sum() > 30 and (expected > 0).sum() > 100
    np.testing.assert_allclose(got, expected, atol=1e-9)


def test_sign_survives_a_hole() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    centre = sphere.triangles_center
    # Five per cent of the surface, around the north pole, is missing.
    holed = SurfaceMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces)[centre[:, 2] < 0.045])
    assert len(holed.faces) < 0.97 * len(sphere.faces)
    points = np.random.default_rng(2).uniform(-0.08, 0.08, (3000, 3))
    radius = np.linalg.norm(points, axis=1)
    away = (np.abs(radius - 0.05) > 0.004) & (points[:, 2] < 0.03)
    got = signed_distance(holed, points[away])
    np.testing.assert_array_equal(np.sign(got), np.sign(radius[away] - 0.05))


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"\(n, 3\).*\(3, 2\)"):
        signed_distance(_surface(trimesh.creation.box((1, 1, 1))), np.zeros((3, 2)))
