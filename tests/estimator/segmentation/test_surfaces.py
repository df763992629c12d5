"""Surfaces of voxels: where they are, which way they face, how large they are."""

import igl
import numpy as np
import pytest

from estimator.segmentation.drawn import CENTRE, GRIDS, HALF_AXES, Grid, grid, masks
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_files.ply_writer import write_ply
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.segmentation.segments import (
    Segment,
    make_segmentation,
    masks_of_labels,
)
from softtissue_estimator.segmentation.surfaces import surface_of_segment

pytest.importorskip("vtkmodules", reason="VTK, of the extra `import`, is not installed")


def segmentation_of(mask, where: Grid):
    affine = where.affine.copy()
    affine[:3] *= 1e-3
    ((cut, start),) = masks_of_labels(mask.astype(np.uint8)).values()
    return make_segmentation([Segment("liver", cut, start)], affine)


@pytest.mark.parametrize("where", GRIDS.values(), ids=GRIDS)
@pytest.mark.parametrize("triangles", [5000, 200_000])
def test_surface_is_that_of_the_body_and_faces_outward(where, triangles):
    found = segmentation_of(masks(where)["liver"], where)
    mesh = surface_of_segment(found.segments[0], found, triangles)
    assert len(mesh.faces) <= triangles
    voxels = found.segments[0].count * found.voxel_volume
    assert enclosed_volume(mesh) == pytest.approx(voxels, rel=1e-3)  # positive: wound outward
    unit = (1e3 * mesh.vertices - CENTRE) / HALF_AXES
    off = (np.linalg.norm(unit, axis=1) - 1.0) * np.linalg.norm(1e3 * mesh.vertices - CENTRE, axis=1)
    assert np.abs(off).max() < 1e3 * found.voxel_diagonal
    normals = igl.per_vertex_normals(mesh.vertices, mesh.faces)
    assert (np.einsum("ij,ij->i", normals, unit / HALF_AXES) > 0.0).mean() > 0.999
    directed = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)  # each edge once in each direction: closed
    assert {*map(tuple, directed)} == {*map(tuple, directed[:, ::-1])}


@pytest.mark.parametrize("radius_voxels", [1.0, 1.5, 2.5])
def test_thin_vessel_keeps_its_volume(radius_voxels):
    where = grid((1.0, 1.0, 1.0))
    at = where.places()
    mask = np.linalg.norm(at[..., 1:] - CENTRE[1:] - 0.2, axis=-1) <= radius_voxels
    mask &= np.abs(at[..., 0] - CENTRE[0]) < 40.0
    found = segmentation_of(mask, where)
    mesh = surface_of_segment(found.segments[0], found, 20_000)
    voxels = found.segments[0].count * found.voxel_volume
    assert enclosed_volume(mesh) == pytest.approx(voxels, rel=0.03)


def test_body_that_ends_with_the_grid_is_closed():
    where = Grid((10, 10, 10), np.diag([2.0, 2.0, 2.0, 1.0]))
    found = segmentation_of(np.ones((10, 10, 10), bool), where)
    mesh = surface_of_segment(found.segments[0], found, 20_000)
    assert enclosed_volume(mesh) == pytest.approx(8e-6, rel=1e-3)
    np.testing.assert_allclose(mesh.vertices.mean(axis=0), 0.009, atol=1e-5)


@pytest.mark.parametrize("system", ["LPS", "RAS"])
def test_written_mesh_is_read_as_the_same_and_states_its_system(tmp_path, system):
    where = GRIDS["oblique"]
    found = segmentation_of(masks(where)["tumor 1"], where)
    mesh = surface_of_segment(found.segments[0], found, 20_000)
    write_ply(tmp_path / "a.ply", mesh, 1e-3, system)
    stored = read_mesh(tmp_path / "a.ply", 1e-3, "LPS")
    assert read_mesh(tmp_path / "a.ply", 1e-3).system == system
    np.testing.assert_allclose(stored.mesh.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(stored.mesh.faces, mesh.faces)
