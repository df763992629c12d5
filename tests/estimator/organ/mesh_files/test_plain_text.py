"""Marks of encodings and UTF-16: every text format is read as without them."""

import codecs
import re

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import LIVER, MM, check_surface, content_of
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_io import read_mesh

ENCODINGS = {
    "utf-8 with a mark": lambda text: codecs.BOM_UTF8 + text.encode(),
    "utf-16 little endian with a mark": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "utf-16 big endian with a mark": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "utf-32 with a mark": lambda text: codecs.BOM_UTF32_LE + text.encode("utf-32-le"),
    "utf-16 little endian": lambda text: text.encode("utf-16-le"),
    "utf-16 big endian": lambda text: text.encode("utf-16-be"),
}


def of_vtk(name):
    points = " ".join(f"{x:.9g}" for x in (LIVER.vertices / MM).ravel())
    count, faces = len(LIVER.vertices), LIVER.faces
    if name.endswith(".vtk"):
        polygons = " ".join(f"3 {a} {b} {c}" for a, b, c in faces)
        return (
            f"# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET POLYDATA\nPOINTS {count} double\n{points}\n"
            f"POLYGONS {len(faces)} {4 * len(faces)}\n{polygons}\n"
        )
    corners, ends = " ".join(map(str, faces.ravel())), " ".join(str(3 * i + 3) for i in range(len(faces)))
    grid = name.endswith(".vtu")
    kind, size = ("UnstructuredGrid", "NumberOfCells") if grid else ("PolyData", "NumberOfPolys")
    array = '<DataArray type="{}" Name="{}" NumberOfComponents="{}" format="ascii">{}</DataArray>'
    types = array.format("UInt8", "types", 1, "5 " * len(faces)) if grid else ""
    cells = "Cells" if grid else "Polys"
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<VTKFile type="{kind}" version="1.0"><{kind}>'
        f'<Piece NumberOfPoints="{count}" {size}="{len(faces)}">'
        f"<Points>{array.format('Float64', 'Points', 3, points)}</Points>"
        f"<{cells}>{array.format('Int64', 'connectivity', 1, corners)}{array.format('Int64', 'offsets', 1, ends)}"
        f"{types}</{cells}></Piece></{kind}></VTKFile>\n"
    )


def of_msh():
    nodes = "\n".join(f"{i + 1} {x:.9g} {y:.9g} {z:.9g}" for i, (x, y, z) in enumerate(LIVER.vertices / MM))
    cells = "\n".join(f"{i + 1} 2 2 0 1 {a} {b} {c}" for i, (a, b, c) in enumerate(LIVER.faces + 1))
    return (
        f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{len(LIVER.vertices)}\n{nodes}\n$EndNodes\n"
        f"$Elements\n{len(LIVER.faces)}\n{cells}\n$EndElements\n"
    )


# Each file of VTK or Gmsh takes a process.
READ_HERE, READ_APART = ["a.obj", "a.ply", "a.stl"], ["a.vtk", "a.vtp", "a.vtu", "a.msh"]
CASES = [(name, encoding) for name in READ_HERE for encoding in ["utf-8", *ENCODINGS]]
CASES += [(name, encoding) for name in READ_APART for encoding in ["utf-8", *list(ENCODINGS)[:2]]]


def text_of(name):
    """Content of a text file of the liver; skips where a library is missing that reads it."""
    if name[2] == "v":
        pytest.importorskip("vtkmodules")
        return of_vtk(name)
    if name == "a.msh":
        pytest.importorskip("meshio")
        return of_msh()
    if name == "a.obj":
        mesh = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False)
        return "\n".join(
            line for line in mesh.export(file_type="obj").splitlines() if line[:2] in ("v ", "f ")
        )
    return content_of({"a.ply": "ply text", "a.stl": "stl_ascii"}[name]).decode()


@pytest.mark.parametrize(("name", "encoding"), CASES)
def test_text_in_any_encoding_is_the_same_mesh(tmp_path, name, encoding):
    (tmp_path / name).write_bytes(ENCODINGS.get(encoding, str.encode)(text_of(name)))
    found = read_mesh(tmp_path / name, MM)
    if name == "a.stl":
        corners = found.mesh.vertices[found.mesh.faces]
        np.testing.assert_allclose(corners, LIVER.vertices[LIVER.faces], atol=1e-7)
    else:
        check_surface(found)


@pytest.mark.parametrize("name", READ_HERE + READ_APART)
def test_decimal_commas_are_named_as_such(tmp_path, name):
    # In coordinates alone, not in the versions of formats.
    text = re.sub(r"(?<=\d)\.(?=\d{2})", ",", text_of(name))
    assert text.count(",") > len(LIVER.vertices)
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match="numbers have a decimal comma, save the file with decimal points"):
        read_mesh(tmp_path / name, MM)


@pytest.mark.parametrize("name", READ_APART)
def test_files_damaged_otherwise_are_not_said_to_have_decimal_commas(tmp_path, name):
    text = text_of(name).replace("title", "voxels of 1,5 mm")
    (tmp_path / name).write_text(text[: len(text) // 2])
    with pytest.raises(MeshError, match="cannot be read as such: ") as caught:
        read_mesh(tmp_path / name, MM)
    assert "comma" not in str(caught.value)


def test_a_binary_file_behind_a_mark_is_read(tmp_path):
    (tmp_path / "a.ply").write_bytes(codecs.BOM_UTF8 + content_of("ply"))
    check_surface(read_mesh(tmp_path / "a.ply", MM))


def test_names_in_any_encoding_do_not_matter(tmp_path):
    content = content_of("obj").replace(b"v ", "# Größe\n".encode("latin-1") + b"v ", 1)
    (tmp_path / "a.obj").write_bytes(content)
    check_surface(read_mesh(tmp_path / "a.obj", MM))


def test_a_mark_before_something_else_is_refused(tmp_path):
    (tmp_path / "a.obj").write_bytes(codecs.BOM_UTF16_LE + b"v\0 \0\xff\xdf\x00")
    with pytest.raises(
        MeshError, match="expected text in UTF-16, as the file begins, got bytes that are none"
    ):
        read_mesh(tmp_path / "a.obj", MM)
    (tmp_path / "b.obj").write_bytes(codecs.BOM_UTF8 + content_of("stl_ascii"))
    with pytest.raises(MeshError, match="expected OBJ, got an STL file; its name should end in .stl"):
        read_mesh(tmp_path / "b.obj", MM)
