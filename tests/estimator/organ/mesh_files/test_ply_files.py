"""PLY: the numbers of vertices are kept whatever else the file holds, damaged files are refused in one sentence."""

import struct

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import LIVER, MM, check_surface, content_of, damaged, outcome
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_files.ply_files import read_ply
from softtissue_estimator.organ.mesh_io import read_mesh

FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"]
CODES = {
    "uchar": "B",
    "char": "b",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}
XYZ = [("float", name) for name in "xyz"]
CORNERS = ("list", "uchar", "int", "vertex_indices")


def ply(kind, elements, comments=(), end="\n"):
    """Write elements, each a name, properties as the header lists them, and rows of numbers and lists."""
    lines = ["ply", f"format {kind} 1.0", *(f"comment {text}" for text in comments)]
    body = b""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    for name, properties, rows in elements:
        lines += [f"element {name} {len(rows)}", *("property " + " ".join(p) for p in properties)]
        for row in rows:
            numbers = []
            for one, value in zip(properties, row, strict=True):
                if one[0] == "list":
                    numbers += [(CODES[one[1]], len(value)), *((CODES[one[2]], v) for v in value)]
                else:
                    numbers.append((CODES[one[0]], value))
            if order:
                body += b"".join(struct.pack(order + code, value) for code, value in numbers)
            else:
                body += (" ".join(f"{value:.9g}" for _, value in numbers) + end).encode()
    return end.join([*lines, "end_header", ""]).encode() + body


def shuffled():
    """The liver in an order of its own, with a second copy of each tenth vertex and vertices that no face uses."""
    rng = np.random.default_rng(3)
    count = len(LIVER.vertices)
    order = rng.permutation(count)
    place = np.argsort(order)
    points = np.concatenate([[[900.0, 0, 0]], LIVER.vertices[order] / MM, LIVER.vertices[order[::10]] / MM])
    faces = place[LIVER.faces] + 1
    double = np.arange(len(points))
    double[1 : count + 1 : 10] = count + 1 + np.arange(len(order[::10]))
    faces[::2] = double[faces[::2]]
    return points, faces


def check_numbers(found, points):
    stored = found.vertex_of_stored
    assert len(stored) == len(points)
    assert stored[0] == -1
    assert (stored[1:] >= 0).all()
    np.testing.assert_allclose(found.mesh.vertices[stored[1:]], MM * points[1:], atol=1e-7)
    assert enclosed_volume(found.mesh) == pytest.approx(enclosed_volume(LIVER), rel=1e-5)


VERTEX_EXTRAS = {
    "nothing": ([], []),
    "texture s t": ([], [("float", "s"), ("float", "t")]),
    "texture u v": ([("double", "u"), ("double", "v")], []),
    "texture_u texture_v": ([], [("float", "texture_u"), ("float", "texture_v")]),
    "normals": ([], [("float", "nx"), ("float", "ny"), ("float", "nz")]),
    "colours": ([("uchar", "red"), ("uchar", "green"), ("uchar", "blue")], [("uchar", "alpha")]),
    "a list": ([("list", "uchar", "float", "weights")], [("short", "label")]),
}
FACE_EXTRAS = {
    "nothing": ([], []),
    "texcoord": ([], [("list", "uchar", "float", "texcoord")]),
    "texcoord before, material, number": (
        [("list", "uchar", "float", "texcoord"), ("uchar", "flags")],
        [("int", "texnumber")],
    ),
}


def filled(rng, properties):
    """A row of numbers; lists of nought to six."""
    return [
        list(rng.integers(0, 100, rng.integers(7))) if p[0] == "list" else int(rng.integers(100))
        for p in properties
    ]


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("vertex", VERTEX_EXTRAS)
@pytest.mark.parametrize("face", FACE_EXTRAS)
def test_the_files_own_numbers_are_kept(tmp_path, kind, vertex, face):
    rng = np.random.default_rng(1)
    points, faces = shuffled()
    before, after = VERTEX_EXTRAS[vertex]
    in_front, behind = FACE_EXTRAS[face]
    elements = [
        ("camera", [("float", "view"), ("list", "uchar", "int", "more")], [[1.0, [1, 2]], [2.0, []]]),
        (
            "vertex",
            [*before, *XYZ, *after],
            [[*filled(rng, before), *p, *filled(rng, after)] for p in points],
        ),
        (
            "face",
            [*in_front, CORNERS, *behind],
            [[*filled(rng, in_front), f, *filled(rng, behind)] for f in faces],
        ),
        ("edge", [("int", "vertex1"), ("int", "vertex2")], [[0, 1]]),
    ]
    (tmp_path / "a.ply").write_bytes(ply(kind, elements, ["TextureFile missing.png"]))
    check_numbers(read_mesh(tmp_path / "a.ply", MM), points)


@pytest.mark.parametrize("kind", FORMATS)
def test_polygons_of_any_size_beside_lines(tmp_path, kind):
    """A hexagonal prism: six quads, two hexagons, a triangle that is stored twice, a line and a face of no corners."""
    ring = [(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3]
    points = [[x, y, z] for z in (0.0, 3.0) for x, y in ring]
    faces = [[i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)] + [
        [5, 4, 3, 2, 1, 0],
        [6, 7, 8, 9, 10, 11],
    ]
    faces += [[0, 1], [], [3]]
    for corners in (
        CORNERS,
        ("list", "int", "uint", "vertex_index"),
        ("list", "ushort", "short", "vertex_indices"),
    ):
        elements = [
            ("vertex", [("double", n) for n in "zyx"], [p[::-1] for p in points]),
            ("face", [corners, ("list", "uchar", "float", "t")], [[f, [0.5] * len(f)] for f in faces]),
        ]
        (tmp_path / "prism.ply").write_bytes(ply(kind, elements))
        found = read_mesh(tmp_path / "prism.ply", 1.0)
        assert trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False).is_watertight
        assert enclosed_volume(found.mesh) == pytest.approx(1.5 * np.sqrt(3.0) * 3.0)


@pytest.mark.parametrize("kind", FORMATS)
def test_strips_of_triangles(tmp_path, kind):
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    strips = [[[0, 2, 1, 3, -1, 0, 3, 2]], [[0, 1, 3]]]
    elements = [("vertex", XYZ, points), ("tristrips", [("list", "int", "int", "vertex_indices")], strips)]
    (tmp_path / "a.ply").write_bytes(ply(kind, elements))
    found = read_mesh(tmp_path / "a.ply", 1.0)
    assert trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False).is_watertight
    assert enclosed_volume(found.mesh) == pytest.approx(1.0 / 6.0)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("kind", FORMATS)
def test_lines_may_end_as_they_like(tmp_path, kind, end):
    elements = [("vertex", XYZ, LIVER.vertices / MM), ("face", [CORNERS], LIVER.faces.tolist())]
    elements[1] = ("face", [CORNERS], [[f] for f in LIVER.faces.tolist()])
    (tmp_path / "liver.ply").write_bytes(ply(kind, elements, ["made elsewhere"], end))
    check_surface(read_mesh(tmp_path / "liver.ply", MM), atol=1e-7)


def test_the_first_byte_after_the_header_may_look_like_the_end_of_a_line(tmp_path):
    elements = [("vertex", [("uchar", "flag"), *XYZ], [[10, 0, 0, 0], [10, 1, 0, 0], [13, 0, 1, 0]])]
    elements.append(("face", [CORNERS], [[[0, 1, 2]]]))
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "a.ply").write_bytes(ply("binary_little_endian", elements, end=end))
        np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_ply_of_trimesh(tmp_path, encoding):
    data = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False).export(
        file_type="ply", encoding=encoding
    )
    (tmp_path / "liver.ply").write_bytes(data)
    check_surface(read_mesh(tmp_path / "liver.ply", MM))


HEAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
WRONG = {
    "decimal comma": (
        HEAD + FACE + "0 0 0\n1,5 0 0\n0 1 0\n3 0 1 2\n",
        "damaged line 11: '1,5 0 0'; numbers have a decimal comma",
    ),
    "too few numbers": (HEAD + FACE + "0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "damaged line 11: '1 0'"),
    "too many": (HEAD + FACE + "0 0 0\n1 0 0 5\n0 1 0\n3 0 1 2\n", "damaged line 11"),
    "a short face": (HEAD + FACE + "0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "damaged line 13: '3 0 1'"),
    "a face of impossible length": (HEAD + FACE + "0 0 0\n1 0 0\n0 1 0\n-1 0 1\n", "damaged line 13"),
    "a vertex that cannot exist": (
        HEAD + FACE + f"0 0 0\n1 0 0\n0 1 0\n3 0 1 {9**30}\n",
        "a face of vertices that cannot exist",
    ),
    "cut off": (
        HEAD + FACE + "0 0 0\n1 0 0\n",
        "expected PLY with 3 rows of vertex, got 2; it is damaged or cut off",
    ),
    "no coordinates": (
        HEAD.replace(" x", " q") + FACE,
        "expected PLY vertices with x, y and z, got none of x",
    ),
    "no corners": (HEAD + FACE.replace("int vertex_indices", "float s"), "."),
    "an impossible count": (
        HEAD.replace("vertex 3", "vertex " + "9" * 30) + FACE,
        "damaged line 3 in its header",
    ),
    "unknown type": (
        HEAD.replace("float y", "real y") + FACE,
        "damaged line 5 in its header: 'property real y'",
    ),
    "two formats": (
        HEAD.replace("element v", "format ascii 1.0\nelement v") + FACE,
        "one line 'format', got 2",
    ),
    "no end": (HEAD, "a file without a whole header"),
    "binary cut off": (
        (HEAD + FACE).replace("ascii", "binary_little_endian") + "0" * 20,
        "expected PLY with 3 rows of vertex, got a file that ends before",
    ),
    "binary with an impossible count": (
        (HEAD.replace("vertex 3", "vertex 999999999999999") + FACE).replace("ascii", "binary_big_endian")
        + "0" * 99,
        "got a file that ends before",
    ),
    "binary faces cut off": (
        (HEAD + FACE).replace("ascii", "binary_little_endian") + "\0" * 36 + "\x07000",
        "expected PLY with 1 rows of face, got a file that ends before",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said(tmp_path, name):
    content, message = WRONG[name]
    (tmp_path / "a.ply").write_text(content)
    with pytest.raises(MeshError, match=message):
        read_ply(tmp_path / "a.ply") if message != "." else read_mesh(tmp_path / "a.ply", 1.0)


@pytest.mark.parametrize("kind", ["ply", "ply text"])
def test_damaged_files_are_refused_or_read(tmp_path, kind):
    path = tmp_path / "damaged.ply"
    outcomes = {outcome(path, content) for content in damaged(content_of(kind), 40, 60)}
    assert outcomes == {"mesh", "one sentence"}
