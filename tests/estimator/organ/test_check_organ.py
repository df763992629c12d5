"""The command that reads an organ folder and says what it found."""

import re

import numpy as np
import pytest
import trimesh

from estimator.shapes import ellipsoid
from softtissue_estimator.organ import check_organ
from softtissue_estimator.support.resources import bundled_organ

LIVER = ellipsoid((0.09, 0.06, 0.05), subdivisions=3)


@pytest.fixture
def folder(tmp_path):
    """A liver in mm, wound inward, with a small hole; attached at one end."""
    faces = np.delete(LIVER.faces, 100, axis=0)[:, ::-1]
    trimesh.Trimesh(LIVER.vertices * 1000.0, faces, process=False).export(tmp_path / "liver.ply")
    (tmp_path / "organ.yaml").write_text(
        "name: Liver\nunit: mm\nsurface: liver.ply\nattached:\n  spheres: [{centre: [90, 0, 0], radius: 25}]\n"
    )
    return tmp_path


def test_what_was_found_and_repaired_is_said(folder, capsys):
    assert check_organ.main([str(folder)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "wound inward, turned outward" in out
    assert "warning: mesh " in out
    assert "closed small holes: 1" in out
    assert "organ: Liver, frame organ\n" in out
    assert "surface: 643 vertices, 1282 triangles, 1.1" in out
    assert "180 x 120 x 100 mm" in out
    assert "volume mesh: " in out


def test_structures_of_the_bundled_organ_lie_inside(capsys):
    assert check_organ.main([str(bundled_organ()), "--no-tetrahedra"]) == 0
    out = capsys.readouterr().out
    assert "structure: portal vein (vessel), 4652 vertices, 100 % inside\n" in out
    assert "volume mesh" not in out
    assert "warning" not in out


def test_what_cannot_be_used_gives_one_sentence_and_exit_code_2(folder, capsys):
    content = (folder / "organ.yaml").read_text()
    (folder / "organ.yaml").write_text(content.replace("unit: mm", "unit: m"))
    assert check_organ.main([str(folder)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "state mm" in err
    assert err.count("\n") == 1


def test_tetrahedra_are_written_and_then_named(folder, capsys):
    path = folder / "more" / "tets.vtu"
    assert check_organ.main([str(folder), "--tetrahedra", str(path)]) == 2
    assert "expected a file that can be written, got 'No such file or directory'" in capsys.readouterr().err
    path.parent.mkdir()
    assert check_organ.main([str(folder), "--tetrahedra", str(path)]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.endswith("once organ.yaml says  tetrahedra: more/tets.vtu")
    with (folder / "organ.yaml").open("a") as file:
        file.write(line.rpartition("  ")[2] + "\n")
    assert check_organ.main([str(folder)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"tetrahedra: \d{4} of [3-9]\d\d nodes, 9[5-9]\.\d % of the surface's volume\n", out)
    assert "filling" not in out


def test_tetrahedra_of_another_name_are_refused_before_anything_is_done(folder, capsys):
    assert check_organ.main([str(folder), "--tetrahedra", str(folder / "tets.stl")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "expected a name that ends in .vtu, got " in err
    assert not (folder / "tets.stl").exists()
