"""The coordinate system that files state: read from every format, and converted to the one that is wanted."""

import logging

import numpy as np
import pytest

from estimator.mesh_file_checks import LIVER, MM, content_of
from estimator.organ_folders import TUMOUR, describe, export
from softtissue_estimator.errors import MeshError, OrganError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.organ import load_organ

SLICER = "3D Slicer output. SPACE=RAS"
FLIPPED = SurfaceMesh(LIVER.vertices * [-1.0, -1.0, 1.0], LIVER.faces)


def written_by_vtk(tmp_path, name, header, field):
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkUnstructuredGrid
    from vtkmodules.vtkIOLegacy import vtkDataSetWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    points, array = vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(LIVER.vertices / MM, deep=True))
    listed = np.column_stack([np.full(len(LIVER.faces), 3), LIVER.faces]).ravel()
    array.ImportLegacyFormat(numpy_to_vtkIdTypeArray(listed, deep=True))
    data = vtkUnstructuredGrid() if name.endswith("vtu") else vtkPolyData()
    data.SetPoints(points)
    data.SetCells(5, array) if name.endswith("vtu") else data.SetPolys(array)
    if field:
        text = vtkStringArray()
        text.SetName("SPACE")
        text.InsertNextValue(field)
        data.GetFieldData().AddArray(text)
    kinds = {"vtk": vtkDataSetWriter, "vtp": vtkXMLPolyDataWriter, "vtu": vtkXMLUnstructuredGridWriter}
    writer = kinds[name[-3:]]()
    if header:
        writer.SetHeader(header)
    writer.SetFileName(str(tmp_path / name))
    writer.SetInputData(data)
    assert writer.Write() == 1


def write(tmp_path, how):
    """Write LIVER so that the file states RAS."""
    name = how.split()[0]
    path = tmp_path / name
    if how == "a.vtk title":
        written_by_vtk(tmp_path, name, SLICER, None)
    elif name[2] == "v":
        written_by_vtk(tmp_path, name, None, "RAS")
    elif name == "a.obj":
        path.write_bytes(f"# {SLICER}\n".encode() + content_of("obj"))
    elif name == "a.ply":
        content = content_of("ply" if how.endswith("binary") else "ply text")
        key = "obj_info" if how.endswith("info") else "comment"
        path.write_bytes(content.replace(b"element vertex", f"{key} {SLICER}\nelement vertex".encode(), 1))
    elif how == "a.stl binary":
        path.write_bytes(SLICER.encode().ljust(80) + content_of("stl")[80:])
    elif how == "a.stl text":
        path.write_bytes(f"solid {SLICER}\n".encode() + content_of("stl_ascii").split(b"\n", 1)[1])
    return path


HOWS = ["a.vtk title", "a.vtk field", "a.vtp field", "a.vtu field", "a.obj", "a.ply text", "a.ply binary"]


@pytest.mark.parametrize("how", [*HOWS, "a.ply info", "a.stl binary", "a.stl text"])
def test_files_that_state_ras_are_converted_to_lps(tmp_path, how, caplog):
    path = write(tmp_path, how)
    assert read_mesh(path, MM).system == "RAS"
    with caplog.at_level(logging.INFO):
        same = read_mesh(path, MM, "RAS")
    assert caplog.text == ""
    with caplog.at_level(logging.INFO):
        found = read_mesh(path, MM, "LPS")
    assert f"mesh {path}: states RAS, converted to LPS" in caplog.text
    assert found.system == "LPS"
    for mesh, wanted in ((same.mesh, LIVER), (found.mesh, FLIPPED)):
        np.testing.assert_allclose(mesh.vertices[mesh.faces], wanted.vertices[wanted.faces], atol=1e-6)


def test_files_that_state_nothing_are_left_alone(tmp_path):
    (tmp_path / "a.obj").write_bytes(content_of("obj"))
    found = read_mesh(tmp_path / "a.obj", MM, "RAS")
    assert found.system is None
    np.testing.assert_allclose(found.mesh.vertices, LIVER.vertices, atol=1e-7)


def test_one_mirrored_axis_turns_the_faces(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"# SPACE=LAS\n" + content_of("obj"))
    found = read_mesh(tmp_path / "a.obj", MM, "RAS").mesh
    assert enclosed_volume(found) == pytest.approx(enclosed_volume(LIVER))
    np.testing.assert_allclose(found.vertices, LIVER.vertices * [-1.0, 1.0, 1.0], atol=1e-7)


@pytest.mark.parametrize(
    ("header", "system"),
    [
        ("SPACE=LPS", "LPS"),
        ("space: right-anterior-superior, mm", "RAS"),
        ("SPACE = ras;", "RAS"),
        ('SPACE="LPS"', "LPS"),
        ("3D Slicer output. SPACE=RAS\n3D Slicer output. SPACE=RAS", "RAS"),
        ("SPACE=RASTER", None),
        ("space=3", None),
        ("workspace=LPS", None),
        ("written by a program", None),
    ],
)
def test_what_headers_state(header, system):
    assert stated_system(header) == system


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("SPACE=LPS SPACE=RAS", "expected one coordinate system, the file states LPS and RAS"),
        ("SPACE=ASR", "expected a coordinate system such as RAS or LPS, the file states SPACE=ASR"),
    ],
)
def test_headers_that_cannot_be_meant(tmp_path, header, message):
    (tmp_path / "a.obj").write_bytes(f"# {header}\n".encode() + content_of("obj"))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "a.obj", MM)


def organ_folder(tmp_path, **spaces):
    """An organ, a tumour and a mesh to touch, each with what its header states or nothing."""
    meshes = {
        "liver": LIVER,
        "tumour": TUMOUR,
        "touch": SurfaceMesh(TUMOUR.vertices + np.array([0.06, 0.0, 0.0]), TUMOUR.faces),
    }
    for name, mesh in meshes.items():
        space = spaces.get(name, "")
        flipped = mesh.vertices * ([-1.0, -1.0, 1.0] if space == "LPS" else [1.0, 1.0, 1.0])
        export(SurfaceMesh(flipped, mesh.faces), tmp_path / f"{name}.obj")
        path = tmp_path / f"{name}.obj"
        path.write_text((f"# SPACE={space}\n" if space else "") + path.read_text())
    return describe(
        tmp_path,
        surface="liver.obj",
        structures=[{"name": "tumour", "mesh": "tumour.obj"}],
        attached={"touching": {"mesh": "touch.obj", "distance": 6}},
    )


@pytest.mark.parametrize(
    "spaces", [{}, {"tumour": "LPS"}, {"touch": "LPS"}, {"tumour": "LPS", "touch": "LPS"}]
)
def test_the_surface_decides_for_the_organ(tmp_path, spaces):
    organ = load_organ(organ_folder(tmp_path, liver="RAS", **spaces))
    np.testing.assert_allclose(organ.surface.vertices, LIVER.vertices, atol=1e-7)
    np.testing.assert_allclose(organ.structures[0].mesh.vertices, TUMOUR.vertices, atol=1e-7)
    assert (organ.surface.vertices[organ.attached][:, 0] > 0.05).all()
    assert organ.system == "RAS"
    assert organ.with_attached(~organ.attached).system == "RAS"


def test_a_surface_that_states_nothing_is_in_the_system_of_the_rest(tmp_path):
    organ = load_organ(organ_folder(tmp_path, tumour="RAS", touch="LPS"))
    assert organ.system == "RAS"
    assert (organ.surface.vertices[organ.attached][:, 0] > 0.05).all()


def test_meshes_that_contradict_each_other_beside_such_a_surface_are_refused(tmp_path):
    folder = organ_folder(tmp_path, tumour="RAS", touch="LPS")
    both = [{"name": "a", "mesh": "tumour.obj"}, {"name": "b", "mesh": "touch.obj"}]
    describe(folder, surface="liver.obj", structures=both)
    with pytest.raises(
        OrganError, match="since structures state LPS and RAS, got liver.obj, which states none"
    ):
        load_organ(folder)


def test_organ_yaml_may_state_the_system_of_a_surface_that_does_not(tmp_path):
    folder = organ_folder(tmp_path, tumour="LPS", touch="RAS")
    path = folder / "organ.yaml"
    path.write_text("system: ras\n" + path.read_text())
    organ = load_organ(folder)
    assert organ.system == "RAS"
    np.testing.assert_allclose(organ.structures[0].mesh.vertices, TUMOUR.vertices, atol=1e-7)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        ("LPS", "system: expected RAS, as liver.obj states, got LPS"),
        ("XYZ", "system: expected LPS or RAS, got"),
    ],
)
def test_organ_yaml_that_contradicts_the_surface_is_refused(tmp_path, system, message):
    folder = organ_folder(tmp_path, liver="RAS")
    path = folder / "organ.yaml"
    path.write_text(f"system: {system}\n" + path.read_text())
    with pytest.raises(OrganError, match=message):
        load_organ(folder)
