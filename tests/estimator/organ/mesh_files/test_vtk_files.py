"""VTK, VTP and VTU: written by VTK they are read as they are; damaged ones neither crash nor deceive."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import BOX, LIVER, MM, check_surface, check_volume, damaged, outcome
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files.vtk_files import _blocks
from softtissue_estimator.organ.mesh_io import read_mesh

LEGACY = [(True, 42), (False, 42), (True, 51), (False, 51)]


@pytest.fixture(scope="module")
def vtk():
    pytest.importorskip("vtkmodules")
    from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkIOLegacy, vtkIOXML

    modules = (vtkCommonCore, vtkCommonDataModel, vtkIOLegacy, vtkIOXML)
    return SimpleNamespace(**{name: value for module in modules for name, value in vars(module).items()})


def vtk_cells(vtk, kind, points_mm, cells):
    """PolyData of triangles (kind 5) or an UnstructuredGrid of one kind of cell."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    points, array = vtk.vtkPoints(), vtk.vtkCellArray()
    points.SetData(numpy_to_vtk(points_mm, deep=True))
    listed = np.column_stack([np.full(len(cells), cells.shape[1]), cells]).ravel()
    array.ImportLegacyFormat(numpy_to_vtkIdTypeArray(listed, deep=True))
    data = vtk.vtkPolyData() if kind == 5 else vtk.vtkUnstructuredGrid()
    data.SetPoints(points)
    if kind == 5:
        data.SetPolys(array)
    else:
        data.SetCells(kind, array)
    return data


def write_vtk(vtk, data, path, ascii_text=False, version=51):
    if path.suffix == ".vtk":
        writer = vtk.vtkDataSetWriter()
        writer.SetFileVersion(version)
        (writer.SetFileTypeToASCII if ascii_text else writer.SetFileTypeToBinary)()
    else:
        writer = vtk.vtkXMLPolyDataWriter() if path.suffix == ".vtp" else vtk.vtkXMLUnstructuredGridWriter()
        (writer.SetDataModeToAscii if ascii_text else writer.SetDataModeToAppended)()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    assert writer.Write() == 1


@pytest.mark.parametrize(
    ("name", "ascii_text", "version"),
    [*(("liver.vtk", *how) for how in LEGACY), ("liver.vtp", True, 0), ("liver.VTP", False, 0)],
)
def test_polydata_of_vtk(vtk, tmp_path, name, ascii_text, version):
    data = vtk_cells(vtk, 5, LIVER.vertices / MM, LIVER.faces)
    path = tmp_path / name.lower()
    write_vtk(vtk, data, path, ascii_text, version)
    check_surface(read_mesh(path.rename(tmp_path / name), MM), atol=1e-6 if ascii_text else 1e-7)


@pytest.mark.parametrize(
    ("name", "ascii_text", "version"),
    [*(("box.vtk", *how) for how in LEGACY), ("box.vtu", True, 0), ("box.vtu", False, 0)],
)
def test_tetrahedra_of_vtk(vtk, tmp_path, name, ascii_text, version):
    data = vtk_cells(vtk, 10, BOX.nodes / MM, BOX.tets)
    write_vtk(vtk, data, tmp_path / name, ascii_text, version)
    check_volume(read_mesh(tmp_path / name, MM), BOX.nodes / MM, 40 * 30 * 20)


def test_quadratic_tetrahedra_of_vtk_keep_the_nodes_on_edges(vtk, tmp_path):
    edges = np.sort(BOX.tets[:, [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]].reshape(-1, 2), axis=1)
    edges, number = np.unique(edges, axis=0, return_inverse=True)
    nodes = np.concatenate([BOX.nodes, BOX.nodes[edges].mean(axis=1)]) / MM
    cells = np.column_stack([BOX.tets, len(BOX.nodes) + number.reshape(-1, 6)])
    write_vtk(vtk, vtk_cells(vtk, 24, nodes, cells), tmp_path / "box.vtu")
    found = read_mesh(tmp_path / "box.vtu", MM)
    check_volume(found, nodes, 40 * 30 * 20)
    flat = trimesh.Trimesh(BOX.nodes, BOX.boundary_faces)
    assert len(found.mesh.faces) == 4 * len(flat.faces)


def test_polygons_strips_and_lines_of_vtk(vtk, tmp_path):
    """A prism over an L, which a fan from its first corner would leave; beside it, a line and a point."""
    outline = np.array([[0, 0], [0, 2], [1, 2], [1, 1], [2, 1], [2, 0]]) * 10.0
    points = vtk.vtkPoints()
    for z in (0.0, 30.0):
        for x, y in outline:
            points.InsertNextPoint(x, y, z)
    data, polygons, strips, lines = (
        vtk.vtkPolyData(),
        vtk.vtkCellArray(),
        vtk.vtkCellArray(),
        vtk.vtkCellArray(),
    )
    for polygon in ([1, 2, 3, 4, 5, 0], [6, 11, 10, 9, 8, 7]):
        polygons.InsertNextCell(6, polygon)
    ring = [i for k in range(7) for i in (k % 6, 6 + k % 6)]
    strips.InsertNextCell(len(ring), ring)
    lines.InsertNextCell(2, [0, 7])
    data.SetPoints(points)
    data.SetPolys(polygons)
    data.SetStrips(strips)
    data.SetLines(lines)
    write_vtk(vtk, data, tmp_path / "prism.vtk")
    mesh = read_mesh(tmp_path / "prism.vtk", MM).mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert abs(solid.volume) == pytest.approx(300 * 30 * 1e-9)
    assert solid.area == pytest.approx((2 * 300 + 80 * 30) * 1e-6)


@pytest.mark.parametrize("name", ["liver.vtk", "liver.vtp"])
def test_damaged_files_of_vtk_are_refused_or_read(vtk, tmp_path, name):
    write_vtk(vtk, vtk_cells(vtk, 5, LIVER.vertices / MM, LIVER.faces), tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    outcomes = {outcome(tmp_path / name, content) for content in damaged(whole, 2, 3)}
    assert outcomes <= {"mesh", "one sentence"}
    assert outcome(tmp_path / name, whole) == "mesh"


def test_a_file_that_crashes_vtk_is_refused(vtk, tmp_path):
    """Cells of version 5.1 under the number of an older one: VTK reads beyond its arrays."""
    path = tmp_path / "liver.vtk"
    write_vtk(vtk, vtk_cells(vtk, 5, LIVER.vertices / MM, LIVER.faces), path)
    content = path.read_bytes()
    assert content.startswith(b"# vtk DataFile Version 5.1")
    assert outcome(path, content.replace(b"Version 5.1", b"Version 3.0", 1)) == "one sentence"


def test_arrays_of_damaged_files_never_reach_beyond_each_other():
    """What VTK passes on: numbers of cell types, offsets and nodes, any of them changed."""
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(300):
        kinds, offsets, nodes = np.full(4, 10), np.arange(0, 20, 4), np.arange(16) % 7
        array = [kinds, offsets, nodes][rng.integers(3)]
        array[rng.integers(len(array))] += rng.integers(-20, 20)
        try:
            blocks = list(_blocks(kinds, offsets, nodes))
        except MeshError:
            refused += 1
        else:
            assert sum(len(block.nodes) for block in blocks) >= 4
    assert 0 < refused < 300


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("liver.vtp", 'NumberOfComponents="3"', 'NumberOfComponents="2000000000"', "expected at most 1000 components"),
        ("liver.vtp", 'NumberOfPoints="', 'NumberOfPoints="999999', "expected at most 20000000 points"),
        ("liver.vtp", 'NumberOfPolys="', 'NumberOfPolys="99999999999999999999', "expected at most 20000000 polys"),
        ("box.vtu", 'NumberOfCells="', 'NumberOfCells="999999', "expected at most 20000000 cells, the file"),
    ],
)  # fmt: skip
def test_files_that_announce_more_than_any_organ_has_are_refused(vtk, tmp_path, name, old, new, message):
    is_grid = name == "box.vtu"
    data = (
        vtk_cells(vtk, 10, BOX.nodes, BOX.tets) if is_grid else vtk_cells(vtk, 5, LIVER.vertices, LIVER.faces)
    )
    write_vtk(vtk, data, tmp_path / name)
    content = (tmp_path / name).read_text(encoding="latin-1")
    assert old in content
    (tmp_path / name).write_text(content.replace(old, new, 1), encoding="latin-1")
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / name, MM)


def test_data_of_points_is_not_read(vtk, tmp_path):
    """Thirty numbers a point, of which none is wanted, and a compressed file."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    data = vtk_cells(vtk, 5, LIVER.vertices / MM, LIVER.faces)
    array = numpy_to_vtk(np.zeros((len(LIVER.vertices), 30)), deep=True)
    array.SetName("data")
    data.GetPointData().AddArray(array)
    write_vtk(vtk, data, tmp_path / "liver.vtp")
    check_surface(read_mesh(tmp_path / "liver.vtp", MM))
