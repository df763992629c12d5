import logging

import numpy as np
import pytest
import trimesh

from estimator.shapes import box_tets, ellipsoid
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ import volume_mesh
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.volume_mesh import clean_tets, tetrahedralise

BOX = box_tets()


def silent(_message):
    pass


def test_boundary_encloses_the_volume_and_faces_outward():
    boundary = SurfaceMesh(BOX.nodes, BOX.boundary_faces)
    assert enclosed_volume(boundary) == pytest.approx(0.04 * 0.03 * 0.02)
    assert BOX.volumes.sum() == pytest.approx(0.04 * 0.03 * 0.02)
    assert trimesh.Trimesh(boundary.vertices, boundary.faces).is_watertight


def test_points_are_found_in_the_tetrahedron_around_them():
    rng = np.random.default_rng(0)
    truth = rng.integers(len(BOX.tets), size=500)
    weights = rng.dirichlet([2.0] * 4, size=500)
    points = np.einsum("nc,ncd->nd", weights, BOX.nodes[BOX.tets[truth]])
    found = BOX.locate(points)
    np.testing.assert_array_equal(found, truth)
    np.testing.assert_allclose(BOX.weights(points, found), weights, atol=1e-12)


def test_linear_fields_are_continued_to_points_near_the_mesh():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.003, [0.043, 0.033, 0.023], size=(500, 3))
    matrix, offset = rng.normal(size=(3, 3)), rng.normal(size=3)
    values = BOX.interpolation(points) @ (BOX.nodes @ matrix.T + offset)
    np.testing.assert_allclose(values, points @ matrix.T + offset, atol=1e-12)


def test_far_points_are_not_extrapolated_without_bound():
    weights = BOX.interpolation(np.array([[10.0, -5.0, 3.0]]))
    assert weights.sum() == pytest.approx(1.0)
    assert weights.data.min() >= -0.75 - 1e-9


def test_no_points_give_an_empty_matrix():
    assert BOX.interpolation(np.empty((0, 3))).shape == (0, len(BOX.nodes))


def test_cleaning_turns_drops_and_keeps_the_largest_part():
    turned = BOX.tets.copy()
    turned[::2] = turned[::2][:, [1, 0, 2, 3]]
    apart = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * 0.005 + 1.0
    nodes = np.concatenate([BOX.nodes, apart])
    flat = [[0, 1, 2, 0]]
    tets = np.concatenate([turned, len(BOX.nodes) + np.array([[0, 1, 2, 3]]), flat])
    mesh = clean_tets(nodes, tets)
    assert mesh.volumes.min() > 0.0
    assert mesh.volumes.sum() == pytest.approx(BOX.volumes.sum())
    assert len(mesh.nodes) == len(BOX.nodes)


def test_nothing_but_flat_tetrahedra_is_an_error():
    with pytest.raises(MeshError, match="expected tetrahedra with a volume, got none"):
        clean_tets(np.zeros((4, 3)), np.array([[0, 1, 2, 3]]))


@pytest.mark.parametrize("missing_faces", [0, 15])
def test_organs_are_filled_also_with_holes(missing_faces, caplog):
    surface = ellipsoid((0.09, 0.06, 0.05), subdivisions=3)
    said = []
    with caplog.at_level(logging.INFO):
        mesh = tetrahedralise(SurfaceMesh(surface.vertices, surface.faces[missing_faces:]), said.append)
    assert 0.95 < mesh.volumes.sum() / enclosed_volume(surface) < 1.03
    assert 250 <= len(mesh.nodes) <= 1100
    assert mesh.volumes.min() > 0.0
    assert "tetrahedra" in said[0]
    assert "of the surface's volume" in caplog.text


def test_mesher_needs_no_pyvista(monkeypatch, tmp_path):
    (tmp_path / "pyvista.py").write_text("raise ModuleNotFoundError('not installed here')", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert len(tetrahedralise(ellipsoid(subdivisions=2), silent).tets) > 500


@pytest.fixture
def mesher(tmp_path, monkeypatch):
    """Put another program in the mesher's place."""

    def replace(text):
        (tmp_path / "mesher.py").write_text(text)
        monkeypatch.setattr(volume_mesh, "_WORKER", tmp_path / "mesher.py")

    return replace


def test_crash_of_the_mesher_is_a_sentence(mesher):
    mesher("import os; os.abort()")
    with pytest.raises(MeshError, match="expected tetrahedra, got exit code -6 from fTetWild"):
        tetrahedralise(ellipsoid(subdivisions=2), silent)


@pytest.mark.parametrize("content", ["", "no archive", None])
def test_mesher_without_a_result_is_a_sentence(mesher, content):
    mesher(
        "" if content is None else f"import pathlib, sys; pathlib.Path(sys.argv[2]).write_text({content!r})"
    )
    with pytest.raises(MeshError, match="expected tetrahedra, got"):
        tetrahedralise(ellipsoid(subdivisions=2), silent)


def test_mesher_without_end_is_a_sentence(mesher, monkeypatch):
    mesher("import time; time.sleep(60)")
    monkeypatch.setattr(volume_mesh, "_TIMEOUT_S", 0.2)
    with pytest.raises(MeshError, match="got none for a surface of 320 triangles"):
        tetrahedralise(ellipsoid(subdivisions=2), silent)


def test_surface_wound_inward_is_refused():
    surface = ellipsoid(subdivisions=2)
    with pytest.raises(MeshError, match="expected a surface with a positive volume"):
        tetrahedralise(SurfaceMesh(surface.vertices, surface.faces[:, ::-1]), silent)
