"""STL and PLY: written by trimesh they are read as they are, damaged ones are refused in one sentence."""

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import LIVER, MM, check_surface, content_of, damaged, outcome
from softtissue_estimator.errors import MeshError
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


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_ply_of_trimesh(tmp_path, encoding):
    data = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False).export(
        file_type="ply", encoding=encoding
    )
    (tmp_path / "liver.ply").write_bytes(data)
    check_surface(read_mesh(tmp_path / "liver.ply", MM))


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "ply", "ply text"])
def test_damaged_files_are_refused_or_read(tmp_path, kind):
    path = tmp_path / f"damaged.{kind[:3]}"
    outcomes = {outcome(path, content) for content in damaged(content_of(kind), 40, 60)}
    assert outcomes == {"mesh", "one sentence"}
