"""From a surface file to tetrahedra: closed, coarse, open and unusable surfaces."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_training.organs.named_surface import organ_from_file
from softtissue_training.organs.tetrahedralise import signed_volumes

RADII = np.array([0.06, 0.045, 0.035])
VOLUME = 4.0 / 3.0 * np.pi * RADII.prod()
SIZE = 0.012


def write_ellipsoid(path, subdivisions, *, unit_m=1e-3, hole_m=0.0, offset=(0.0, 0.0, 0.0)):
    """Write an ellipsoid off the origin; faces near one end are left out for a hole."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    ball.apply_transform(np.diag([*RADII, 1.0]))
    keep = np.linalg.norm(ball.triangles_center - [RADII[0], 0.0, 0.0], axis=1) > hole_m
    assert keep.all() == (hole_m == 0.0)
    mesh = trimesh.Trimesh((ball.vertices + offset) / unit_m, ball.faces[keep])
    mesh.export(path)
    return path


def volume(mesh):
    return float(signed_volumes(mesh.vertices, mesh.tets).sum())


@pytest.mark.parametrize(("name", "unit_m"), [("organ.stl", 1e-3), ("organ.ply", 1.0)])
def test_a_closed_surface_is_filled_and_centred(tmp_path, name, unit_m):
    path = write_ellipsoid(tmp_path / name, 4, unit_m=unit_m, offset=(0.3, -0.1, 0.2))
    mesh = organ_from_file(path, unit_m, SIZE)
    assert volume(mesh) == pytest.approx(VOLUME, rel=0.04)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert np.abs(low + high).max() < 0.004
    assert high - low == pytest.approx(2.0 * RADII, rel=0.06)
    edges = mesh.surface.vertices[mesh.faces] - mesh.surface.vertices[np.roll(mesh.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).mean() == pytest.approx(SIZE, rel=0.15)


def test_a_coarse_surface_is_cut_finer_first(tmp_path):
    path = write_ellipsoid(tmp_path / "coarse.ply", 1)
    coarse = trimesh.load_mesh(path)
    mesh = organ_from_file(path, 1e-3, SIZE)
    assert volume(mesh) == pytest.approx(1e-9 * coarse.volume, rel=0.04)
    assert len(mesh.faces) > 2 * len(coarse.faces)


def test_an_open_surface_is_mended(tmp_path):
    path = write_ellipsoid(tmp_path / "open.stl", 4, hole_m=0.02)
    assert not trimesh.load_mesh(path).is_watertight
    mesh = organ_from_file(path, 1e-3, SIZE)
    assert trimesh.Trimesh(mesh.surface.vertices, mesh.faces, process=False).is_watertight
    assert volume(mesh) == pytest.approx(VOLUME, rel=0.06)


def test_what_does_not_fit_is_said(tmp_path):
    path = write_ellipsoid(tmp_path / "organ.stl", 3)
    with pytest.raises(MeshError, match=r"expected an organ that fits a cube of 0.3 m, got one of 120 m"):
        organ_from_file(path, 1.0)


def test_a_flat_surface_is_refused(tmp_path):
    sheet = trimesh.creation.box((100.0, 80.0, 60.0))
    sheet.update_faces(sheet.face_normals[:, 2] > 0.5)
    sheet.export(tmp_path / "sheet.ply")
    with pytest.raises(MeshError, match="sheet.ply: expected a surface that encloses a volume"):
        organ_from_file(tmp_path / "sheet.ply", 1e-3)
