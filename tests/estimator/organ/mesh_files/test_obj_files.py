"""OBJ: the numbers of vertices are kept, damaged files are refused in one sentence."""

import numpy as np
import pytest
import trimesh

from estimator.mesh_file_checks import LIVER, MM, check_surface, content_of, damaged, outcome
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_io import read_mesh


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


def test_damaged_files_are_refused_or_read(tmp_path):
    outcomes = {outcome(tmp_path / "damaged.obj", content) for content in damaged(content_of("obj"), 40, 60)}
    assert outcomes == {"mesh", "one sentence"}
