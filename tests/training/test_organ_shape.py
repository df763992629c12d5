import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import SurfaceMesh, enclosed_volume
from softtissue_training.organ_shape import CUBE_SIDE_M, random_organ_surface, resample


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
        assert 0.2e-3 * 0.9 < enclosed_volume(organ) < 3.0e-3


def test_organs_lie_centred_in_the_cube(organs):
    for organ in organs:
        assert np.abs(organ.vertices).max() <= CUBE_SIDE_M / 2
        middle = 0.5 * (organ.vertices.min(axis=0) + organ.vertices.max(axis=0))
        np.testing.assert_allclose(middle, 0.0, atol=8e-3)  # coarse triangles cut corners


def test_organs_vary_in_size_and_slenderness(organs):
    volumes = [enclosed_volume(organ) for organ in organs]
    assert max(volumes) > 3 * min(volumes)
    extents = np.array(
        [np.sort(trimesh.PointCloud(organ.vertices).bounding_box_oriented.extents) for organ in organs]
    )
    slenderness = extents[:, 0] / extents[:, 2]
    assert slenderness.min() < 0.6
    assert slenderness.max() > 0.7


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
