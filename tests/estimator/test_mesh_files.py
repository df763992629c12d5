"""Meshes written by each format's own library are read as they are, damaged ones are refused in one sentence."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from estimator.shapes import box_tets, ellipsoid
from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.mesh_files.vtk_files import _blocks
from softtissue_estimator.mesh_io import MESH_FORMATS, read_mesh

MM = 1e-3
LIVER = ellipsoid((0.09, 0.06, 0.05), subdivisions=2)
BOX = box_tets()


def check_surface(found, atol=1e-7):
    """Tell that what was read is LIVER, its vertices in their order."""
    np.testing.assert_allclose(found.mesh.vertices, LIVER.vertices, atol=atol)
    np.testing.assert_array_equal(found.mesh.faces, LIVER.faces)
    np.testing.assert_array_equal(found.vertex_of_stored, np.arange(len(LIVER.vertices)))


def check_volume(found, points_mm, volume_mm3, atol=1e-7):
    """Tell that what was read is the closed, outward surface of a volume mesh, its vertices known by their number."""
    mesh, stored = found.mesh, found.vertex_of_stored
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert enclosed_volume(mesh) == pytest.approx(1e-9 * volume_mm3, rel=1e-5)
    assert len(stored) == len(points_mm)
    assert (stored >= 0).sum() == len(mesh.vertices) < len(points_mm)
    np.testing.assert_allclose(mesh.vertices[stored[stored >= 0]], MM * points_mm[stored >= 0], atol=atol)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
@pytest.mark.parametrize("name", ["liver.stl", "LIVER.STL"])
def test_stl_of_trimesh_has_each_vertex_once(tmp_path, kind, name):
    data = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False).export(file_type=kind)
    (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    found = read_mesh(tmp_path / name, MM)
    corners = found.mesh.vertices[found.mesh.faces]
    np.testing.assert_allclose(corners, LIVER.vertices[LIVER.faces], atol=1e-7)
    assert len(found.mesh.vertices) == len(LIVER.vertices)


def test_binary_stl_may_begin_like_text_and_text_may_hold_several_solids(tmp_path):
    ball = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False)
    binary = ball.export(file_type="stl")
    (tmp_path / "a.stl").write_bytes(b"solid made elsewhere".ljust(80) + binary[80:])
    assert len(read_mesh(tmp_path / "a.stl", MM).mesh.faces) == len(LIVER.faces)
    text = ball.export(file_type="stl_ascii")
    (tmp_path / "b.stl").write_text(f"{text}\n{text.replace(' 0.', ' 1.')}")
    assert len(read_mesh(tmp_path / "b.stl", MM).mesh.faces) == 2 * len(LIVER.faces)
    (tmp_path / "b.stl").write_text(f"{text}\n{text[: len(text) // 2]}")
    with pytest.raises(
        MeshError, match="960 of 14.* vertices in complete solids; it is damaged, cut off or no STL"
    ):
        read_mesh(tmp_path / "b.stl", MM)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_ply_of_trimesh(tmp_path, encoding):
    data = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False).export(
        file_type="ply", encoding=encoding
    )
    (tmp_path / "liver.ply").write_bytes(data)
    check_surface(read_mesh(tmp_path / "liver.ply", MM))


def test_obj_of_trimesh_with_normals_and_texture(tmp_path):
    textured = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False)
    rng = np.random.default_rng(0)
    textured.visual = trimesh.visual.TextureVisuals(uv=rng.random((len(LIVER.vertices), 2)))
    text = textured.export(file_type="obj", include_normals=True, include_texture=True)
    text = text[0] if isinstance(text, tuple) else text
    assert "vt " in text
    assert "vn " in text
    (tmp_path / "liver.obj").write_text(text)
    check_surface(read_mesh(tmp_path / "liver.obj", MM))


def test_obj_keeps_the_numbers_of_vertices_that_share_texture_or_are_unused(tmp_path):
    """A cube of quads as Blender writes it, in two objects, with counts from the end and a broken line."""
    (tmp_path / "cube.obj").write_text(
        "mtllib missing.mtl\no lower\nv 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0 # comment\nv 0 1 0\nvt 0 0\nvt 1 1\n"
        "f 2/1 5/2 4/1 3/2\no upper\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nusemtl a\nf -4 -3 -2 -1\n"
        "f 2//1 3//1 7//1 6//1\nf 3/1/1 4/1/1 8/1/1 7/1/1\nl 1 2\nf 4 5 9 \\\n8\ng x\nf 5 2 6 9\n"
    )
    found = read_mesh(tmp_path / "cube.obj", 1.0)
    assert found.vertex_of_stored.tolist() == [-1, *range(8)]
    assert enclosed_volume(found.mesh) == pytest.approx(1.0)
    assert len(found.mesh.faces) == 12


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


LEGACY = [(True, 42), (False, 42), (True, 51), (False, 51)]


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


@pytest.fixture(scope="module")
def gmsh():
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 15.0)
    yield gmsh
    gmsh.finalize()


def gmsh_box(gmsh, path, dimension=3, order=1, version=4.1, binary=False, hexahedra=False, group=False):
    """Write a box of 80 x 60 x 40 mm and return its nodes as Gmsh has them."""
    gmsh.clear()
    gmsh.model.occ.addBox(-10.0, 0.0, 5.0, 80.0, 60.0, 40.0)
    gmsh.model.occ.synchronize()
    if hexahedra:
        for _, curve in gmsh.model.getEntities(1):
            gmsh.model.mesh.setTransfiniteCurve(curve, 4)
        for _, surface in gmsh.model.getEntities(2):
            gmsh.model.mesh.setTransfiniteSurface(surface)
            gmsh.model.mesh.setRecombine(2, surface)
        gmsh.model.mesh.setTransfiniteVolume(1)
    gmsh.model.mesh.generate(dimension)
    gmsh.model.mesh.setOrder(order)
    if group:
        gmsh.model.addPhysicalGroup(3, [1], 7, name="liver of 'A', right")
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", int(binary))
    gmsh.write(str(path))
    return gmsh.model.mesh.getNodes()[1].reshape(-1, 3)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("order", [1, 2])
def test_tetrahedra_of_gmsh(gmsh, tmp_path, version, binary, order):
    """Without physical groups Gmsh writes points, lines and triangles beside the tetrahedra."""
    nodes = gmsh_box(
        gmsh, tmp_path / "box.msh", version=version, binary=binary, order=order, group=order == 2
    )
    check_volume(read_mesh(tmp_path / "box.msh", MM), nodes, 80 * 60 * 40)


def test_surfaces_and_hexahedra_of_gmsh(gmsh, tmp_path):
    nodes = gmsh_box(gmsh, tmp_path / "box.msh", dimension=2)
    found = read_mesh(tmp_path / "box.msh", MM)
    assert (found.vertex_of_stored >= 0).all()
    np.testing.assert_allclose(found.mesh.vertices[found.vertex_of_stored], MM * nodes, atol=1e-9)
    assert abs(enclosed_volume(found.mesh)) == pytest.approx(80e-3 * 60e-3 * 40e-3)
    nodes = gmsh_box(gmsh, tmp_path / "hexa.MSH".lower(), hexahedra=True)
    check_volume(read_mesh((tmp_path / "hexa.msh").rename(tmp_path / "hexa.MSH"), MM), nodes, 80 * 60 * 40)


def test_another_version_of_msh_is_named(gmsh, tmp_path):
    gmsh_box(gmsh, tmp_path / "box.msh", version=4.0)
    with pytest.raises(
        MeshError, match="expected MSH version 2.2 or 4.1, got 4; save it as one of them in Gmsh"
    ):
        read_mesh(tmp_path / "box.msh", MM)


@pytest.mark.parametrize("name", ["box.vtu", "box.vtk", "box.msh"])
def test_tetrahedra_and_triangles_of_meshio(tmp_path, name):
    meshio = pytest.importorskip("meshio")
    cells = [("triangle", BOX.boundary_faces[::3]), ("tetra", BOX.tets), ("line", BOX.tets[:5, :2])]
    meshio.Mesh(BOX.nodes / MM, cells).write(
        tmp_path / name, file_format="gmsh22" if name == "box.msh" else None
    )
    check_volume(read_mesh(tmp_path / name, MM), BOX.nodes / MM, 40 * 30 * 20)


def content_of(kind: str) -> bytes:
    ball = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False)
    data = ball.export(file_type=kind.split()[0], **({"encoding": "ascii"} if kind == "ply text" else {}))
    return data if isinstance(data, bytes) else data.encode()


def damaged(whole: bytes, cuts: int, flips: int):
    """Yield beginnings of a file and copies with flipped bits, half of these near the beginning."""
    rng = np.random.default_rng(5)
    for end in rng.integers(1, len(whole), size=cuts):
        yield whole[:end]
    for i in range(flips):
        content = bytearray(whole)
        for place in rng.integers(len(content) if i % 2 else min(300, len(content)), size=1 + i % 5):
            content[place] ^= 1 << int(rng.integers(8))
        yield bytes(content)


def outcome(path, content: bytes) -> str:
    path.write_bytes(content)
    try:
        mesh = read_mesh(path, MM).mesh
    except MeshError as error:
        return "one sentence" if path.name in str(error) and "\n" not in str(error) else f"bad: {error}"
    return "mesh" if np.isfinite(mesh.vertices).all() and len(mesh.faces) else "bad mesh"


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "ply", "ply text", "obj"])
def test_damaged_files_are_refused_or_read(tmp_path, kind):
    path = tmp_path / f"damaged.{kind[:3]}"
    outcomes = {outcome(path, content) for content in damaged(content_of(kind), 40, 60)}
    assert outcomes == {"mesh", "one sentence"}


@pytest.mark.parametrize("name", ["liver.vtk", "liver.vtp"])
def test_damaged_files_of_vtk_are_refused_or_read(vtk, tmp_path, name):
    write_vtk(vtk, vtk_cells(vtk, 5, LIVER.vertices / MM, LIVER.faces), tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    outcomes = {outcome(tmp_path / name, content) for content in damaged(whole, 2, 3)}
    assert outcomes <= {"mesh", "one sentence"}
    assert outcome(tmp_path / name, whole) == "mesh"


def test_damaged_files_of_gmsh_are_refused_or_read(gmsh, tmp_path):
    gmsh_box(gmsh, tmp_path / "box.msh", binary=True)
    whole = (tmp_path / "box.msh").read_bytes()
    outcomes = {outcome(tmp_path / "box.msh", content) for content in damaged(whole, 2, 4)}
    assert outcomes <= {"mesh", "one sentence"}
    assert outcome(tmp_path / "box.msh", whole) == "mesh"


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
