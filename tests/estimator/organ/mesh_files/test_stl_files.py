"""STL: written by trimesh it is read as it is, damaged files are refused in one sentence."""

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import LIVER, MM, content_of, damaged, outcome
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files import stl_files
from softtissue_estimator.organ.mesh_io import read_mesh


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


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_damaged_files_are_refused_or_read(tmp_path, kind):
    path = tmp_path / "damaged.stl"
    outcomes = {outcome(path, content) for content in damaged(content_of(kind), 40, 60)}
    assert outcomes == {"mesh", "one sentence"}


def test_text_that_other_programs_read(tmp_path, capfd):
    """Words in capitals or with a gap, names made of the format's own words, gaps and blank lines."""
    text = content_of("stl_ascii").decode()
    body = text.split("\n", 1)[1].rsplit("endsolid", 1)[0]
    for i, variant in enumerate(
        (
            f"solid normal vertex facet\n{body}endsolid normal vertex facet\n",
            f"solid\n{body}end solid\n",
            f"  SOLID A\n{body.upper()}ENDSOLID\n",
            f"solid a\n{body.replace('endloop', 'end loop').replace('endfacet', 'end facet')}endsolid",
            f"solid a\r\n\r\n{body}endsolid a\r\n".replace("\n", "\r\n").replace("vertex ", "vertex\t  "),
            f"solid a\n{body}endsolid a\n".replace("\n", "\r"),
        )
    ):
        (tmp_path / f"{i}.stl").write_bytes(variant.encode())
        corners = (found := read_mesh(tmp_path / f"{i}.stl", MM).mesh).vertices[found.faces]
        np.testing.assert_allclose(corners, LIVER.vertices[LIVER.faces], atol=1e-7)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("padding", [1, 2, 49])
def test_bytes_after_the_last_triangle_are_ignored(tmp_path, padding):
    (tmp_path / "a.stl").write_bytes(content_of("stl") + b"\0" * padding)
    assert len(read_mesh(tmp_path / "a.stl", MM).mesh.faces) == len(LIVER.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((".", ","), "got a damaged line .* numbers have a decimal comma, save the file with decimal points"),
        (("endloop", "vertex 1 2 3\nendloop"), "got a triangle without three corners before line 8"),
        (("vertex", "vertex 1"), "got a damaged line"),
    ],
)
def test_damaged_text_is_named(tmp_path, change, message):
    text = content_of("stl_ascii").decode()
    (tmp_path / "a.stl").write_text(text.replace(change[0], change[1], 1 if "loop" in change[0] else -1))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "a.stl", MM)


def test_numbers_that_are_none_are_refused_without_a_warning(tmp_path):
    """NumPy warns of what it makes of a signalling NaN; warnings are errors here."""
    binary = bytearray(content_of("stl"))
    binary[84 + 12 : 84 + 16] = bytes([1, 0, 0xA0, 0x7F])
    (tmp_path / "a.stl").write_bytes(bytes(binary))
    with pytest.raises(MeshError, match="expected finite coordinates, got 1 vertices with NaN or inf"):
        read_mesh(tmp_path / "a.stl", MM)


@pytest.mark.parametrize("piece", [1, 100, 5000, 60_000])
def test_long_text_is_read_in_pieces(tmp_path, monkeypatch, piece):
    path = tmp_path / "a.stl"
    path.write_bytes(content_of("stl_ascii"))
    monkeypatch.setattr(stl_files, "_text", None)  # the slow way is not taken
    whole = read_mesh(path, MM).mesh
    monkeypatch.setattr(stl_files, "_PIECE_BYTES", piece)
    assert len(path.read_bytes()) > 60_000
    np.testing.assert_array_equal(read_mesh(path, MM).mesh.vertices, whole.vertices)
    np.testing.assert_array_equal(read_mesh(path, MM).mesh.faces, whole.faces)


def test_loops_of_other_than_three_corners_are_refused_though_all_are_three_times_as_many(tmp_path):
    lines = content_of("stl_ascii").decode().splitlines()
    moved = [i for i, line in enumerate(lines) if "vertex" in line][2]
    lines.insert(moved + 4, lines.pop(moved))  # behind the next loop's beginning
    (tmp_path / "a.stl").write_text("\n".join(lines))
    with pytest.raises(MeshError, match="got a triangle without three corners before line"):
        read_mesh(tmp_path / "a.stl", MM)
