import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_training.organs.organ_shape import (
    CUBE_SIDE_M,
    VOLUME_RANGE_M3,
    check_self_intersection,
    random_organ_surface,
)
from softtissue_training.organs.resampling import resample


@pytest.fixture(scope="module")
def organs():
    found = []
    for seed in range(14):
        try:
            found.append(random_organ_surface(np.random.default_rng(seed), 0.02))
        except MeshError:
            continue
    return found


def test_organs_are_closed_and_of_genus_zero_with_outward_faces(organs):
    assert len(organs) >= 8
    for organ in organs:
        mesh = trimesh.Trimesh(organ.vertices, organ.faces, process=False)
        assert mesh.is_watertight
        assert mesh.euler_number == 2
        assert 0.2e-3 < enclosed_volume(organ) < 3.0e-3


def test_organs_lie_centred_in_the_cube(organs):
    for organ in organs:
        assert np.abs(organ.vertices).max() <= CUBE_SIDE_M / 2
        middle = 0.5 * (organ.vertices.min(axis=0) + organ.vertices.max(axis=0))
        np.testing.assert_allclose(middle, 0.0, atol=1e-9)


def test_organs_vary_in_size_and_slenderness(organs):
    volumes = [enclosed_volume(organ) for organ in organs]
    assert max(volumes) > 3 * min(volumes)
    slenderness = [_flatness(organ) for organ in organs]
    assert min(slenderness) < 0.45
    assert max(slenderness) > 0.7


def test_the_seed_decides():
    first, again = (random_organ_surface(np.random.default_rng(5), 0.02) for _ in range(2))
    other = random_organ_surface(np.random.default_rng(6), 0.02)
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.faces, again.faces)
    assert first.vertices.shape != other.vertices.shape or not np.allclose(first.vertices, other.vertices)


def test_resampling_gives_triangles_of_the_wanted_size_and_keeps_the_shape():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.06)
    coarse = resample(SurfaceMesh(np.asarray(ball.vertices), np.asarray(ball.faces)), 0.01)
    edges = trimesh.Trimesh(coarse.vertices, coarse.faces, process=False).edges_unique_length
    assert np.median(edges) == pytest.approx(0.01, rel=0.1)
    assert edges.max() < 0.02
    assert enclosed_volume(coarse) == pytest.approx(4 / 3 * np.pi * 0.06**3, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(coarse.vertices, axis=1), 0.06, rtol=2e-3)


def test_resampling_needs_a_finer_surface():
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.06)
    with pytest.raises(MeshError, match="faces wanted, got 80"):
        resample(SurfaceMesh(np.asarray(ball.vertices), np.asarray(ball.faces)), 0.01)


def test_a_surface_that_cuts_itself_is_found():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    whole = SurfaceMesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    check_self_intersection(whole)
    # The top is pulled down through the bottom.
    vertices = whole.vertices.copy()
    vertices[:, 2] -= 0.15 * np.exp(-((whole.vertices[:, 2] - 0.06) ** 2) / (2 * 0.005**2))
    with pytest.raises(MeshError, match="must not cut itself"):
        check_self_intersection(SurfaceMesh(vertices, whole.faces))


def test_organs_that_cut_themselves_are_refused(monkeypatch):
    # A whole turn of the bend folds every organ over itself.
    monkeypatch.setattr(
        "softtissue_training.organs.organ_shape.bend", lambda points, length, angle: _folded(points)
    )
    monkeypatch.setattr("softtissue_training.organs.organ_shape.VOLUME_RANGE_M3", (-1.0, 1.0))
    with pytest.raises(MeshError, match="must not cut itself"):
        random_organ_surface(np.random.default_rng(1), 0.015)


def _folded(points):
    result = points.copy()
    result[:, 0] = 0.1 * np.sin(40.0 * points[:, 0])
    return result


def _flatness(organ):
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(organ.vertices.T)))
    return spread[0] / spread[2]


def test_livers_are_large_and_flat():
    low, high = VOLUME_RANGE_M3
    flatness = []
    for seed in range(6):
        organ = random_organ_surface(np.random.default_rng([1, seed]), 0.02, "liver")
        assert max(low, 0.5e-3) < enclosed_volume(organ) < high
        flatness.append(_flatness(organ))
    assert np.median(flatness) < 0.6


def test_mixed_organs_are_livers_or_the_random_ones():
    liver, random, mixed = (
        [random_organ_surface(np.random.default_rng([2, seed]), 0.015, shapes).vertices for seed in range(12)]
        for shapes in ("liver", "random", "mixed")
    )
    same = [
        (np.array_equal(m, one), np.array_equal(m, other))
        for m, one, other in zip(mixed, liver, random, strict=True)
    ]
    assert all(a != b for a, b in same)
    assert {a for a, _ in same} == {True, False}
