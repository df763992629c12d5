"""Organ folders as users have them."""

import logging
import sys
import time

import numpy as np
import pytest
import yaml

from estimator.organ_folders import LIVER, TIP, TUMOUR, VEIN, describe, export
from estimator.shapes import rotation, sphere
from softtissue_estimator.errors import MeshError, OrganError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.organ import Organ, Structure, load_organ, make_organ


def test_everything_is_read_and_in_metres(folder):
    organ = load_organ(describe(folder))
    assert (organ.name, organ.frame, organ.folder) == ("Liver", "scan", folder)
    np.testing.assert_allclose(organ.surface.vertices, LIVER.vertices, atol=1e-8)
    np.testing.assert_array_equal(organ.surface.faces, LIVER.faces)
    assert (organ.structures[0].name, organ.structures[0].kind) == ("tumour", "tumour")
    assert organ.structures[0].colour == (1.0, 0.5, 0.0, 1.0)
    np.testing.assert_allclose(organ.structure_points, TUMOUR.vertices, atol=1e-8)
    within = np.linalg.norm(LIVER.vertices - [0.09, 0.0, 0.0], axis=1) <= 0.025
    np.testing.assert_array_equal(organ.attached, within)


def test_metres_are_metres(folder):
    export(LIVER, folder / "liver.ply", scale=1.0)
    organ = load_organ(
        describe(
            folder, unit="m", structures=[], attached={"spheres": [{"centre": [0.09, 0, 0], "radius": 0.025}]}
        )
    )
    assert enclosed_volume(organ.surface) == pytest.approx(enclosed_volume(LIVER), rel=1e-5)
    assert 0 < organ.attached.sum() < len(LIVER.vertices) / 4


def test_query_points_are_structures_in_order_then_the_surface(folder):
    structures = [{"name": n, "mesh": f"{n}.ply"} for n in ("vein", "tumour")]
    organ = load_organ(describe(folder, structures=structures))
    expected = np.concatenate([VEIN.vertices, TUMOUR.vertices, LIVER.vertices])
    np.testing.assert_allclose(organ.query_points, expected, atol=1e-8)
    np.testing.assert_array_equal(
        organ.structure_index, np.repeat([0, 1], [len(VEIN.vertices), len(TUMOUR.vertices)])
    )
    assert organ.structure_index.dtype == np.uint32


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_formats_of_trimesh_give_the_same_surface(folder, suffix):
    export(LIVER, folder / f"liver{suffix}")
    organ = load_organ(describe(folder, surface=f"liver{suffix}"))
    assert len(organ.surface.vertices) == len(LIVER.vertices)
    assert enclosed_volume(organ.surface) == pytest.approx(enclosed_volume(LIVER), rel=1e-5)


def vtk_surface():
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(LIVER.vertices * 1000.0, deep=True))
    listed = np.column_stack([np.full(len(LIVER.faces), 3), LIVER.faces]).ravel()
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(listed, deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    return data


def vtk_volume():
    """Tetrahedra from the centre to every face; the centre is stored first."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    points, cells, data = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(numpy_to_vtk(np.concatenate([[[0.0, 0.0, 0.0]], LIVER.vertices * 1000.0]), deep=True))
    tets = np.column_stack([np.full(len(LIVER.faces), 4), np.zeros(len(LIVER.faces), int), LIVER.faces + 1])
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(tets.ravel(), deep=True))
    data.SetPoints(points)
    data.SetCells(10, cells)
    return data


def write_vtk(data, path, ascii_text=False):
    from vtkmodules.vtkIOLegacy import vtkDataSetWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    writer = {".vtk": vtkDataSetWriter, ".vtp": vtkXMLPolyDataWriter, ".vtu": vtkXMLUnstructuredGridWriter}[
        path.suffix
    ]()
    if path.suffix == ".vtk":
        (writer.SetFileTypeToASCII if ascii_text else writer.SetFileTypeToBinary)()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.Write()


@pytest.mark.parametrize(
    ("name", "make", "ascii_text", "first"),
    [
        ("surface.vtk", vtk_surface, False, 0),
        ("volume.vtu", vtk_volume, False, 1),
    ],
)
def test_formats_of_vtk_give_the_same_surface_and_vertex_numbers(folder, name, make, ascii_text, first):
    pytest.importorskip("vtkmodules")
    write_vtk(make(), folder / name, ascii_text)
    listed = [int(i) + first for i in np.flatnonzero(LIVER.vertices[:, 2] > 0.04)]
    organ = load_organ(describe(folder, surface=name, attached={"vertices": listed}))
    assert enclosed_volume(organ.surface) == pytest.approx(enclosed_volume(LIVER), rel=1e-5)
    np.testing.assert_array_equal(organ.attached, organ.surface.vertices[:, 2] > 0.04)
    assert organ.attached.sum() == len(listed)


@pytest.mark.parametrize(("name", "module"), [("liver.vtk", "vtkmodules"), ("liver.msh", "meshio")])
def test_missing_library_is_named_with_its_extra(folder, monkeypatch, name, module):
    (folder / name).write_text("# some content\n")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        MeshError, match=r"library, which is not installed \(pip install .*extra softtissue_est"
    ):
        load_organ(describe(folder, surface=name))


@pytest.mark.parametrize(
    "name", ["liver.vtk", "liver.vtp", "liver.vtu", "liver.stl", "liver.obj", "liver.ply", "liver.doc"]
)
def test_file_that_is_no_mesh_is_one_sentence(folder, name, capfd):
    if name.endswith(("vtk", "vtp", "vtu")):
        pytest.importorskip("vtkmodules")
    (folder / name).write_bytes(b"This is not a mesh.\n" * 20)
    with pytest.raises(MeshError, match=name) as caught:
        load_organ(describe(folder, surface=name))
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_truncated_mesh_is_one_sentence(folder):
    data = (folder / "liver.ply").read_bytes()
    (folder / "liver.ply").write_bytes(data[: len(data) // 2])
    with pytest.raises(MeshError, match="liver.ply"):
        load_organ(describe(folder))


def test_three_ways_of_attachment_are_joined(folder):
    (folder / "attached.txt").write_text("0\n5\n7\n")
    attached = {**TIP, "vertices": "attached.txt", "touching": {"mesh": "vein.ply", "distance": 12}}
    organ = load_organ(describe(folder, attached=attached))
    expected = np.linalg.norm(LIVER.vertices - [0.09, 0.0, 0.0], axis=1) <= 0.025
    # The vein is a sphere of many small triangles; the vertices tested lie clear of the limit.
    gap = np.linalg.norm(LIVER.vertices - [0.095, 0.0, 0.0], axis=1) - 0.008
    clear = np.abs(gap - 0.012) > 5e-4
    expected |= gap <= 0.012
    expected[[0, 5, 7]] = True
    np.testing.assert_array_equal(organ.attached[clear], expected[clear])


def test_inward_winding_is_turned(folder):
    export(SurfaceMesh(LIVER.vertices, LIVER.faces[:, ::-1]), folder / "liver.ply")
    assert enclosed_volume(load_organ(describe(folder)).surface) == pytest.approx(
        enclosed_volume(LIVER), rel=1e-5
    )


def test_single_turned_faces_are_turned_back(folder, caplog):
    faces = LIVER.faces.copy()
    faces[::7] = faces[::7, ::-1]
    export(SurfaceMesh(LIVER.vertices, faces), folder / "liver.ply")
    with caplog.at_level(logging.WARNING):
        organ = load_organ(describe(folder))
    assert enclosed_volume(organ.surface) == pytest.approx(enclosed_volume(LIVER), rel=1e-5)
    assert "opposite directions" in caplog.text


def test_flat_bodies_beside_the_organ_are_dropped_with_a_warning(folder, caplog):
    count = len(LIVER.vertices)
    sliver = sphere(0.002, centre=(0.2, 0.0, 0.0), subdivisions=0)
    vertices = np.concatenate([LIVER.vertices, sliver.vertices])
    faces = np.concatenate([sliver.faces + count, LIVER.faces])
    export(SurfaceMesh(vertices, faces), folder / "liver.ply")
    with caplog.at_level(logging.WARNING):
        organ = load_organ(describe(folder))
    assert len(organ.surface.vertices) == count
    assert "bodies without volume beside the organ: 1" in caplog.text


def test_small_holes_are_tolerated(folder):
    export(SurfaceMesh(LIVER.vertices, LIVER.faces[20:]), folder / "liver.ply")
    assert enclosed_volume(load_organ(describe(folder)).surface) == pytest.approx(
        enclosed_volume(LIVER), rel=0.05
    )


def test_missing_attachment_is_allowed_with_a_warning(folder, caplog):
    with caplog.at_level(logging.WARNING):
        organ = load_organ(describe(folder, attached=None))
    assert not organ.attached.any()
    assert "nothing about where the organ is attached" in caplog.text


def test_tetrahedra_are_attached_by_the_numbers_of_their_file(folder, caplog):
    """Nodes inside are on no surface; they are left out with a line in the log."""
    meshio = pytest.importorskip("meshio")
    nodes = np.concatenate([[[0.0, 0.0, 0.0]], LIVER.vertices]) * 1000.0
    tets = np.column_stack([np.zeros(len(LIVER.faces), dtype=int), LIVER.faces + 1])
    meshio.Mesh(nodes, [("tetra", tets)]).write(folder / "liver.msh", file_format="gmsh")
    listed = [0, *(int(i) + 1 for i in np.flatnonzero(LIVER.vertices[:, 2] > 0.04))]
    with caplog.at_level(logging.INFO):
        organ = load_organ(describe(folder, surface="liver.msh", attached={"vertices": listed}))
    np.testing.assert_array_equal(organ.attached, organ.surface.vertices[:, 2] > 0.04)
    assert "1 of the " in caplog.text
    with pytest.raises(OrganError, match="attached: expected some of the 642 surface vertices, got none"):
        load_organ(describe(folder, surface="liver.msh", attached={"vertices": [0]}))


def test_an_open_surface_is_refused(folder):
    keep = LIVER.vertices[LIVER.faces].mean(axis=1)[:, 2] < 0.03
    export(SurfaceMesh(LIVER.vertices, LIVER.faces[keep]), folder / "liver.ply")
    with pytest.raises(MeshError, match=r"liver.ply: expected a closed surface, got an opening"):
        load_organ(describe(folder))


def test_list_of_vertices_does_not_fit_an_stl(folder):
    export(LIVER, folder / "liver.stl")
    with pytest.raises(OrganError, match="numbers its vertices, got an STL"):
        load_organ(describe(folder, surface="liver.stl", attached={"vertices": [1, 2, 3]}))


def organ_with(surface=LIVER, attached=0, structure=TUMOUR, name="tumour") -> Organ:
    flags = np.zeros(len(surface.vertices), dtype=bool)
    flags[attached] = True
    return make_organ("x", "organ", surface, (Structure(name, "tumour", structure, (1, 1, 1, 1)),), flags)


def test_digest_is_that_of_the_content():
    same = SurfaceMesh(LIVER.vertices.copy(), LIVER.faces.copy())
    turned = SurfaceMesh(LIVER.vertices @ rotation([0, 0, 1], 1e-9).T, LIVER.faces)
    assert organ_with().digest == organ_with(surface=same).digest
    others = [
        organ_with(surface=turned),
        organ_with(attached=1),
        organ_with(structure=VEIN),
        organ_with(name="vein"),
    ]
    assert len({organ_with().digest, *(organ.digest for organ in others)}) == 5


def test_attached_flags_must_fit_the_surface():
    with pytest.raises(OrganError, match="one flag for each of the 642 surface vertices"):
        Organ("x", "organ", LIVER, (), np.zeros(3, dtype=bool), None, "")


def test_openhelp_liver_loads_in_seconds(test_data, tmp_path):
    spheres = [{"centre": [-35.0, 20.0, 140.0], "radius": 60}]
    content = {
        "unit": "mm",
        "surface": str(test_data / "openhelp" / "liver.stl"),
        "attached": {"spheres": spheres},
    }
    (tmp_path / "organ.yaml").write_text(yaml.safe_dump(content))
    start = time.perf_counter()
    organ = load_organ(tmp_path)
    assert time.perf_counter() - start < 10.0
    assert (len(organ.surface.vertices), len(organ.surface.faces)) == (15_365, 30_726)
    assert enclosed_volume(organ.surface) == pytest.approx(1.818e-3, rel=1e-3)


def test_patient_of_binary_vtk_files_loads(test_data, tmp_path, caplog):
    pytest.importorskip("vtkmodules")
    patient = test_data / "patient"
    names = ["portal_vein", "hepatic_veins", "liver_tumours"]
    content = {
        "unit": "mm",
        "surface": str(patient / "liver.vtk"),
        "structures": [
            {"name": name, "kind": "vessel", "mesh": str(patient / f"{name}.vtk")} for name in names
        ],
        "attached": {"touching": {"mesh": str(patient / "portal_vein.vtk"), "distance": 3}},
    }
    (tmp_path / "organ.yaml").write_text(yaml.safe_dump(content))
    with caplog.at_level(logging.WARNING):
        organ = load_organ(tmp_path)
    assert enclosed_volume(organ.surface) == pytest.approx(2.316e-3, rel=1e-3)
    assert "bodies without volume beside the organ: 5" in caplog.text
    assert [s.name for s in organ.structures] == names
    assert 0.0 < organ.attached.mean() < 0.2
