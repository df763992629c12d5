"""Distances and overlaps of surfaces against closed forms, and what a moving plane sees."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.breathing.plane_cut import plane_cuts
from softtissue_training.experiments.breathing.tree_distance import (
    dice,
    dilate,
    directed_distance,
    surface_distance,
    symmetric_distance,
)


def sphere(radius, centre=(0.0, 0.0, 0.0), subdivisions=5):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return SurfaceMesh(np.array(ball.vertices) + centre, np.array(ball.faces))


def square(height, side=0.05, cells=4):
    axis = np.linspace(0.0, side, cells + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + cells + 1, corner + 1], axis=1),
            np.stack([corner + 1, corner + cells + 1, corner + cells + 2], axis=1),
        ]
    )
    return SurfaceMesh(vertices, faces)


def joined(meshes):
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return SurfaceMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def dilated_dice(first, second, dilation, voxel):
    return dice([dilate(first, dilation, voxel)], [dilate(second, dilation, voxel)])


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii():
    found = surface_distance(sphere(0.02), sphere(0.027))
    assert_allclose([found.mean_m, found.p95_m, found.max_m], 0.007, rtol=0.01)


def test_a_surface_is_where_it_is():
    found = surface_distance(sphere(0.02, subdivisions=3), sphere(0.02, subdivisions=3))
    assert_allclose([found.mean_m, found.p95_m, found.max_m], 0.0, atol=1e-9)


def test_parallel_squares_are_apart_by_their_distance_whatever_their_triangles():
    found = surface_distance(square(0.0), square(0.004, cells=7))
    assert_allclose([found.mean_m, found.p95_m, found.max_m], 0.004, rtol=1e-9)


def test_distance_is_symmetric_and_sees_what_one_surface_alone_has():
    whole = joined([square(0.0), square(0.03)])
    found, back = surface_distance(square(0.0), whole), surface_distance(whole, square(0.0))
    assert found == back
    # One square lies on the other, the third is 30 mm away: (0 + 0 + 30) / 3, and that is more than 5 % of the whole.
    assert_allclose(found.mean_m, 0.010, rtol=1e-9)
    assert_allclose([found.p95_m, found.max_m], 0.03, rtol=1e-9)


def test_percentile_counts_area_and_not_points():
    # A tenth of the area is off by 10 mm, in triangles far smaller than those of the rest.
    whole = joined([square(0.0, side=0.09, cells=3), square(0.01, side=0.03, cells=60)])
    flat = square(0.0, side=0.09, cells=3)
    found = surface_distance(whole, flat)
    assert_allclose(found.mean_m, 0.01 * 0.1 / 1.9, rtol=1e-6)
    assert_allclose(found.p95_m, 0.01, rtol=1e-9)
    few = joined([square(0.0, side=0.2, cells=3), square(0.01, side=0.03, cells=60)])
    # The small one is 2.2 % of the area, though more than half of the points.
    assert_allclose(surface_distance(few, square(0.0, side=0.2, cells=3)).p95_m, 0.0, atol=1e-9)


def test_sphere_beside_a_shifted_one_has_the_mean_distance_of_the_integral():
    radius, shift = 0.02, 0.005
    found = surface_distance(sphere(radius), sphere(radius, (shift, 0.0, 0.0)))
    cosine = np.linspace(-1.0, 1.0, 200_001)
    expected = np.abs(np.sqrt(radius**2 + shift**2 - 2.0 * radius * shift * cosine) - radius).mean()
    assert_allclose(found.mean_m, expected, rtol=0.01)
    assert_allclose(found.max_m, shift, rtol=0.01)


def test_vessels_of_a_tree_are_compared_each_with_its_own_counterpart():
    # Two squares that change places are where they were as a set, and wrong each.
    low, high = square(0.0), square(0.02, side=0.1)
    there = [directed_distance(low, high), directed_distance(high, low)]
    back = [directed_distance(high, low), directed_distance(low, high)]
    assert symmetric_distance(there, back).mean_m > 0.02 - 1e-9
    apart = [directed_distance(square(0.0), square(0.001)), directed_distance(high, square(0.023, side=0.1))]
    # The larger square counts four times.
    assert_allclose(symmetric_distance(apart, apart).mean_m, (0.001 + 4 * 0.003) / 5, rtol=1e-9)


def test_dice_of_a_tree_is_that_of_the_union():
    first, second = sphere(0.008, subdivisions=3), sphere(0.008, (0.05, 0.0, 0.0), subdivisions=3)
    one, two = dilate(first, 0.004, 0.002), dilate(second, 0.004, 0.002)
    assert dice([one, two], [one]) == pytest.approx(2.0 / 3.0, abs=0.005)
    assert dice([one, two], [two, one]) == 1.0


@pytest.mark.parametrize("shift", [0.0, 0.006, 0.012])
def test_dice_of_dilated_spheres_is_that_of_larger_ones(shift):
    radius, dilation = 0.009, 0.006
    found = dilated_dice(sphere(radius), sphere(radius, (shift, 0.0, 0.0)), dilation, 0.001)
    large = radius + dilation
    common = np.pi * (4 * large + shift) * (2 * large - shift) ** 2 / 12.0
    assert found == pytest.approx(common / (4.0 / 3.0 * np.pi * large**3), abs=0.004)


def test_dice_counts_what_the_surface_encloses():
    # The ball is thicker than the dilation reaches; its core belongs to it nevertheless.
    found = dilated_dice(sphere(0.02), sphere(0.01), 0.003, 0.001)
    assert found == pytest.approx(2 * 13**3 / (13**3 + 23**3), abs=0.005)


def test_dice_of_what_is_apart_is_zero():
    assert dilated_dice(sphere(0.005), sphere(0.005, (0.03, 0.0, 0.0)), 0.005, 0.001) == 0.0


def test_dice_refuses_a_dilation_below_its_voxel():
    with pytest.raises(InvalidInputError, match="at least a voxel"):
        dilated_dice(sphere(0.02, subdivisions=2), sphere(0.02, subdivisions=2), 0.001, 0.002)


def test_plane_sees_a_sphere_as_archimedes_says():
    ball = sphere(0.05)
    direction = np.array([1.0, -2.0, 0.5])
    cuts = plane_cuts(ball, direction, steps=10)
    assert [cut.position for cut in cuts] == pytest.approx(np.arange(10) / 10)
    # A zone of a sphere has the area of the cylinder's around it.
    assert_allclose([cut.visible_share for cut in cuts], 1.0 - np.arange(10) / 10, atol=0.01)
    for cut in cuts:
        middle = ball.triangles.mean(axis=1) @ direction / np.linalg.norm(direction)
        assert middle[cut.faces].min() >= middle[~cut.faces].max() if cut.position else cut.faces.all()


def test_plane_starts_behind_whatever_the_axis_is_called():
    ball = sphere(0.05, subdivisions=3)
    front = plane_cuts(ball, np.array([0.0, -1.0, 0.0]), steps=2)[1].faces
    assert (ball.triangles[front].mean(axis=1)[:, 1] <= 0.0).all()


@pytest.mark.parametrize(
    ("direction", "steps", "message"),
    [([0, 0, 0], 3, "not all zero"), ([np.nan, 0, 1], 3, "not all zero"), ([0, 1, 0], 0, "at least 1")],
)
def test_plane_refuses_what_cannot_be_meant(direction, steps, message):
    with pytest.raises(InvalidInputError, match=message):
        plane_cuts(sphere(0.05, subdivisions=1), np.array(direction, dtype=float), steps)
