"""Tetrahedra that an organ folder names: read as they were written, used, and refused unless they fill the organ."""

import numpy as np
import pytest
import trimesh

from estimator.organ_folders import describe, export
from estimator.shapes import box_tets
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import MeshError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_files import vtk_files
from softtissue_estimator.organ.mesh_files.plain_vtu import plain_vtu
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.tetrahedra_file import read_tetrahedra, write_tetrahedra
from softtissue_estimator.organ.volume_mesh import VolumeMesh

MM = 1e-3
LENGTHS = (0.12, 0.09, 0.06)
FILLED = box_tets(LENGTHS, (6, 5, 4))
BODY = trimesh.Trimesh(FILLED.nodes, FILLED.boundary_faces, process=True)
SURFACE = SurfaceMesh(np.asarray(BODY.vertices), np.asarray(BODY.faces))
ATTACHED = {"spheres": [{"centre": [0, 0, 0], "radius": 50}]}


@pytest.fixture
def organ_folder(tmp_path):
    """A box that names its tetrahedra."""
    export(SURFACE, tmp_path / "liver.ply")
    write_tetrahedra(tmp_path / "tets.vtu", FILLED, MM, SURFACE)
    return describe(tmp_path, structures=None, attached=ATTACHED, tetrahedra="tets.vtu")


def text_of(nodes, tets):
    return plain_vtu(np.asarray(nodes) / MM, np.asarray(tets), 6)


def refusal(path, content):
    path.write_text(content)
    with pytest.raises(MeshError) as caught:
        read_tetrahedra(path, MM, None, SURFACE)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_was_written_is_read_again_without_the_vtk_library(organ_folder, monkeypatch):
    monkeypatch.setattr(vtk_files, "require_library", None)
    found = load_organ(organ_folder).tetrahedra
    np.testing.assert_allclose(found.nodes, FILLED.nodes, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(found.tets, FILLED.tets)


@pytest.mark.parametrize("unit_m", [0.001, 1.0])
def test_unit_is_that_of_the_folder(tmp_path, unit_m):
    write_tetrahedra(tmp_path / "tets.vtu", FILLED, unit_m, SURFACE)
    found = read_tetrahedra(tmp_path / "tets.vtu", unit_m, None, SURFACE)
    np.testing.assert_allclose(found.nodes, FILLED.nodes, rtol=0.0, atol=1e-9)


def test_vtk_reads_the_same(tmp_path, monkeypatch):
    pytest.importorskip("vtkmodules")
    write_tetrahedra(tmp_path / "tets.vtu", FILLED, MM, SURFACE)
    monkeypatch.setattr(vtk_files, "is_plain_vtu", lambda content: False)
    found = read_tetrahedra(tmp_path / "tets.vtu", MM, None, SURFACE)
    np.testing.assert_allclose(found.nodes, FILLED.nodes, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(found.tets, FILLED.tets)


def test_tetrahedra_of_others_are_read_whichever_way_their_nodes_are_numbered(tmp_path):
    meshio = pytest.importorskip("meshio")
    loose = np.concatenate([FILLED.nodes, [[9.0, 9.0, 9.0]]]) / MM  # a node of no cell
    for name, order in (("a.msh", [0, 1, 2, 3]), ("b.vtu", [1, 0, 2, 3])):
        cells = [("triangle", FILLED.tets[:3, :3]), ("tetra", FILLED.tets[:, order])]
        meshio.Mesh(loose, cells).write(tmp_path / name, "gmsh22" if name == "a.msh" else "vtu")
        found = read_tetrahedra(tmp_path / name, MM, None, SURFACE)
        assert len(found.nodes) == len(FILLED.nodes)
        assert found.volumes.min() > 0.0
        assert found.volumes.sum() == pytest.approx(np.prod(LENGTHS))


def test_organ_with_other_tetrahedra_is_another_one(organ_folder):
    named = load_organ(organ_folder)
    without = load_organ(describe(organ_folder, structures=None, attached=ATTACHED))
    moved = FILLED.nodes + 1e-4 * np.random.default_rng(0).normal(size=FILLED.nodes.shape)
    write_tetrahedra(organ_folder / "tets.vtu", VolumeMesh(moved, FILLED.tets), MM, SURFACE)
    other = load_organ(describe(organ_folder, structures=None, attached=ATTACHED, tetrahedra="tets.vtu"))
    assert without.tetrahedra is None
    assert len({organ.digest for organ in (named, without, other)}) == 3
    assert len({organ.geometry_digest for organ in (named, without, other)}) == 3
    assert named.with_attached(~named.attached).geometry_digest == named.geometry_digest
    assert named.with_attached(~named.attached).tetrahedra is named.tetrahedra


def test_answers_are_the_same_from_cache_to_cache(organ_folder, tmp_path_factory, monkeypatch):
    monkeypatch.setattr("softtissue_estimator.estimators.elastic.model.tetrahedralise", None)
    seen = SURFACE.vertices[SURFACE.vertices[:, 2] > 0.05]
    pushed = np.column_stack([0.0 * seen[:, :2], 0.8 * seen[:, 0] ** 2])
    found = []
    for name in ("one", "other"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp(name)))
        estimator = ElasticEstimator(EstimatorConfig(poisson_ratio_sigma=0.0))
        estimator.load_organ(load_organ(organ_folder))
        np.testing.assert_array_equal(estimator.mesh.tets, FILLED.tets)
        found.append(estimator.estimate(Observation(seen, pushed, np.full(len(seen), 0.001))))
    np.testing.assert_array_equal(found[0].displacement, found[1].displacement)
    np.testing.assert_array_equal(found[0].sigma, found[1].sigma)


def squeezed():
    """One inner node pushed through the elements around it."""
    nodes = FILLED.nodes.copy()
    inner = np.setdiff1d(np.arange(len(nodes)), FILLED.boundary_faces)[0]
    nodes[inner] += [0.03, 0.0, 0.0]
    return nodes, FILLED.tets


def with_nan():
    nodes = FILLED.nodes.copy()
    nodes[7] = np.nan
    return nodes, FILLED.tets


def two_bodies():
    apart = [0.12, 0.0, 0.0] + 0.0 * FILLED.nodes
    part = box_tets((0.06, 0.09, 0.06), (3, 5, 4))
    nodes = np.concatenate([part.nodes, part.nodes + 0.5 * apart[: len(part.nodes)]])
    return nodes, np.concatenate([part.tets, part.tets + len(part.nodes)])


def without_a_corner():
    inside = FILLED.nodes[FILLED.tets].mean(axis=1) < [0.041, 0.037, 0.031]
    return FILLED.nodes, FILLED.tets[~inside.all(axis=1)]


@pytest.mark.parametrize(
    ("mesh", "why"),
    [
        (squeezed(), "positive volume, got .* flat or inverted"),
        (with_nan(), "finite coordinates, got 1 nodes"),
        (two_bodies(), "one body whose tetrahedra share faces, got 2"),
        (without_a_corner(), "within 4.8 mm of the organ's surface, got 30.0 mm"),
        ((FILLED.nodes, np.concatenate([FILLED.tets, FILLED.tets[200:201]])), "at a face, got one with more"),
        ((FILLED.nodes + np.array([0.0, 0.0, 0.02]), FILLED.tets), "of the organ's surface, got 20.0 mm"),
        ((FILLED.nodes * [-1.0, -1.0, 1.0], FILLED.tets), "in LPS and the other in RAS"),
        ((1e200 * FILLED.nodes, FILLED.tets), "flat or inverted"),
        ((1000.0 * FILLED.nodes, FILLED.tets), "648 ml to 10 %, got .* probably in another unit"),
        ((0.9 * FILLED.nodes, FILLED.tets), "648 ml to 10 %, got 472.4 ml$"),
        ((box_tets(LENGTHS).nodes, box_tets(LENGTHS).tets), "100 to 2000 nodes .*, got 60"),
        ((box_tets(LENGTHS, (15, 14, 12)).nodes, box_tets(LENGTHS, (15, 14, 12)).tets), "nodes .*, got 3120"),
    ],
)
def test_what_does_not_fill_the_organ_is_a_sentence(tmp_path, mesh, why):
    path = tmp_path / "tets.vtu"
    path.write_text(text_of(*mesh))
    with pytest.raises(MeshError, match=why):
        read_tetrahedra(path, MM, None, SURFACE)


def test_surfaces_and_other_cells_are_a_sentence(tmp_path, organ_folder):
    meshio = pytest.importorskip("meshio")
    corners = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    )
    meshio.Mesh(100.0 * corners, [("hexahedron", [list(range(8))])]).write(tmp_path / "cube.vtu")
    for name, why in (("liver.ply", "got a surface"), ("cube.vtu", "cells of kind hexahedron")):
        with pytest.raises(MeshError, match=f"expected tetrahedra, got .*{why}|{why}"):
            read_tetrahedra(tmp_path / name, MM, None, SURFACE)


def test_damaged_files_are_a_sentence(tmp_path):
    path, whole = tmp_path / "tets.vtu", text_of(FILLED.nodes, FILLED.tets)
    assert "numbers in Points" in refusal(path, whole.replace("20.000000", "20,000000", 1))
    assert "decimal comma" in refusal(path, whole.replace("20.000000", "20,000000", 1))
    first = whole.index("\n", whole.index("connectivity")) + 1
    rest = whole[whole.index(" ", first) :]
    assert "numbers in connectivity" in refusal(path, whole[:first] + "x" + rest)
    assert "vertices 0 to 209" in refusal(path, whole[:first] + "999" + rest)
    assert "four nodes a cell" in refusal(path, whole.replace("\n10\n", "\n12\n", 1))
    for size in (150, 400, 5000, len(whole) - 4000):
        assert "expected" in refusal(path, whole[:size])
    refused = 0
    rng = np.random.default_rng(0)
    for _ in range(30):
        content = bytearray(whole.encode())
        content[int(rng.integers(200, len(content)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(content))
        try:
            read_tetrahedra(path, MM, None, SURFACE)
        except MeshError:
            refused += 1
    assert refused > 5
