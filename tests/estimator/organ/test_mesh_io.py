"""Files of any format: what is no mesh is refused in one sentence, and what meshio writes is read."""

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import BOX, MM, check_volume, content_of
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_io import MESH_FORMATS, read_mesh


@pytest.mark.parametrize("name", ["box.vtu", "box.vtk", "box.msh"])
def test_tetrahedra_and_triangles_of_meshio(tmp_path, name):
    meshio = pytest.importorskip("meshio")
    cells = [("triangle", BOX.boundary_faces[::3]), ("tetra", BOX.tets), ("line", BOX.tets[:5, :2])]
    meshio.Mesh(BOX.nodes / MM, cells).write(
        tmp_path / name, file_format="gmsh22" if name == "box.msh" else None
    )
    check_volume(read_mesh(tmp_path / name, MM), BOX.nodes / MM, 40 * 30 * 20)


WRONG = {
    "empty.vtu": (b"", "expected a mesh, got an empty file"),
    "text.stl": (
        b"Patient 7, see the other folder.\n" * 20,
        "got text with 0 of 0 vertices in complete solids",
    ),
    "cut.stl": (
        content_of("stl")[:8000],
        "got 8000 bytes where a binary .* announces 320 triangles has 16084",
    ),
    "ply.stl": (content_of("ply"), "expected STL, got a PLY file; its name should end in .ply"),
    "stl.ply": (content_of("stl_ascii"), "expected PLY, got an STL file; its name should end in .stl"),
    "page.obj": (b"<!DOCTYPE html><html>404</html>", "expected OBJ, got a web page"),
    "lfs.stl": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
        "expected STL, got a Git LFS pointer",
    ),
    "points.obj": (b"v 0 0 0\nv 1 0 0\n", "expected triangles or volume cells, got 2 vertices and no cells"),
    "lines.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        b"end_header\n0 0 0\n1 1 1\n",
        "expected triangles or volume cells, got .* no cells",
    ),
    "range.obj": (
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
        "expected cells of vertices 0 to 2, got vertex 3 in one",
    ),
    "below.obj": (
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n",
        "expected cells of vertices 0 to 2, got vertex -1 in one",
    ),
    "huge.obj": (b"v 0 0 0\nf 1 2 99999999999999999999\n", "got a face of vertices that cannot exist"),
    "nan.obj": (
        b"v 0 0 nan\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n",
        "expected finite coordinates, got 2 vertices with NaN",
    ),
    "flat.obj": (
        b"v 0 0 0\nv 1 0 0\nv 1 0 0\nf 1 2 3\n",
        "expected triangles with an area, got none among 1",
    ),
    "dot.obj": (b"v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\n", "expected a surface with an extent"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "got a damaged line 4: 'f 1 2'"),
    "no.msh": (b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "MSH of Gmsh.*damaged or cut off"),
    "lines.vtk": (
        b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0 1 0 0\nLINES 1 3\n2 0 1\n",
        "expected triangles or volume cells, got 2 vertices and cells of kind line only",
    ),
    "image.vtk": (
        b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 2\nORIGIN 0 0 0\n"
        b"SPACING 1 1 1\n",
        "expected PolyData or UnstructuredGrid with points, got .*: it holds StructuredPoints",
    ),
    "xml.vtk": (
        b'<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0">\n</VTKFile>\n',
        "expected VTK, got PolyData of VTK; its name should end in .vtp",
    ),
    "liver.nii.gz": (b"\x1f\x8b", r"expected one of .stl, .ply, .obj, .vtk, .vtp, .vtu, .msh, got .gz"),
    "liver": (b"solid", "got no extension"),
}


@pytest.mark.parametrize(("name", "content", "message"), [(n, *what) for n, what in WRONG.items()], ids=WRONG)
def test_wrong_files_are_one_sentence(tmp_path, name, content, message, capfd):
    if name.endswith((".vtk", ".vtu")):
        pytest.importorskip("vtkmodules")
    if name.endswith(".msh"):
        pytest.importorskip("meshio")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh(tmp_path / name, MM)
    assert str(caught.value).startswith(f"mesh {tmp_path / name}: expected")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_folders_and_missing_files_are_no_meshes(tmp_path, suffix):
    (tmp_path / f"a{suffix}").mkdir()
    with pytest.raises(MeshError, match="expected a file, found a folder"):
        read_mesh(tmp_path / f"a{suffix}", MM)
    with pytest.raises(MeshError, match="expected a file, found none"):
        read_mesh(tmp_path / f"b{suffix}", MM)


def test_vertices_of_no_cell_may_be_anywhere(tmp_path):
    (tmp_path / "a.obj").write_text("v nan 0 0\nv 1e30 0 0\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 3 4 5\n")
    found = read_mesh(tmp_path / "a.obj", 1.0)
    assert found.vertex_of_stored.tolist() == [-1, -1, 0, 1, 2]
    assert isinstance(found.mesh, SurfaceMesh)


def test_cells_with_vertices_of_their_own_make_one_body(tmp_path):
    """A file in which no two tetrahedra share a vertex, as filters of ParaView leave it."""
    meshio = pytest.importorskip("meshio")
    pytest.importorskip("vtkmodules")
    points = BOX.nodes[BOX.tets].reshape(-1, 3)
    meshio.Mesh(points / MM, [("tetra", np.arange(len(points)).reshape(-1, 4))]).write(tmp_path / "apart.vtu")
    found = read_mesh(tmp_path / "apart.vtu", MM)
    assert trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False).is_watertight
    assert len(found.mesh.faces) == len(BOX.boundary_faces)
    # Each copy of a vertex names the one that stays.
    used = found.vertex_of_stored >= 0
    np.testing.assert_allclose(found.mesh.vertices[found.vertex_of_stored[used]], points[used], atol=1e-9)
