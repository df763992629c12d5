"""Meshes of far more triangles than needed: fewer, in the same place, with the attached vertices where they were."""

import logging

import numpy as np
import pytest

from estimator.shapes import ellipsoid
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ import decimation
from softtissue_estimator.organ.decimation import MOST_TRIANGLES, decimated
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.signed_distance import signed_distance


@pytest.fixture(scope="module")
def fine():
    mesh = ellipsoid((0.09, 0.06, 0.05), subdivisions=7)
    ripples = 1.0 + 0.003 * np.sin(300.0 * mesh.vertices).sum(axis=1, keepdims=True)
    return SurfaceMesh(mesh.vertices * ripples, mesh.faces)


def test_the_surface_stays_where_it_was(fine, caplog):
    assert len(fine.faces) > MOST_TRIANGLES
    with caplog.at_level(logging.WARNING):
        fewer, nearest = decimated(fine, "liver.ply")
    assert 50_000 < len(fewer.faces) <= 61_000
    assert f"mesh liver.ply: its {len(fine.faces)} triangles are reduced to {len(fewer.faces)}" in caplog.text
    assert enclosed_volume(fewer) == pytest.approx(enclosed_volume(fine), rel=1e-3)
    assert np.abs(signed_distance(fewer, fine.vertices[::50])).max() < 2e-4
    np.testing.assert_allclose(fewer.vertices[nearest], fine.vertices, atol=2e-3)


def test_small_meshes_stay_as_they_are():
    mesh = ellipsoid(subdivisions=4)
    same, numbers = decimated(mesh, "a.stl")
    assert same is mesh
    np.testing.assert_array_equal(numbers, np.arange(len(mesh.vertices)))


def test_listed_vertices_are_attached_where_they_were(fine, tmp_path):
    unused = np.array([[9.0, 9.0, 9.0]])
    rows = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in np.concatenate([unused, 1e3 * fine.vertices])]
    rows += [f"f {a} {b} {c}" for a, b, c in fine.faces + 2]
    (tmp_path / "liver.obj").write_text("\n".join(rows))
    listed = 1 + np.flatnonzero(fine.vertices[:, 0] > 0.06)
    np.savetxt(tmp_path / "attached.txt", listed, fmt="%d")
    (tmp_path / "organ.yaml").write_text("unit: mm\nsurface: liver.obj\nattached: {vertices: attached.txt}\n")
    organ = load_organ(tmp_path)
    x = organ.surface.vertices[:, 0]
    assert organ.attached[x > 0.062].all()
    assert not organ.attached[x < 0.058].any()


def test_a_cloud_of_triangles_that_cannot_be_reduced_is_refused(monkeypatch):
    monkeypatch.setattr(decimation, "MOST_TRIANGLES", 1000)
    monkeypatch.setattr(decimation, "_KEPT_TRIANGLES", 300)
    vertices = np.random.default_rng(0).random((3 * 2000, 3))
    soup = SurfaceMesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    with pytest.raises(
        MeshError, match="expected a surface that can be given by 300 triangles, got 2000 that"
    ):
        decimated(soup, "soup.stl")
