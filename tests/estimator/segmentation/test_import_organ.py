"""The command that makes an organ folder of a segmentation."""

import re

import numpy as np
import pytest
import yaml

from estimator.segmentation.drawn import CENTRE, GRIDS, TUMOUR, labels, masks
from estimator.segmentation.files import TYPES, write_nibabel, write_slicerio
from recorded_data import PATIENT, RECORDED
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.segmentation import import_organ, reading

pytest.importorskip("nrrd", reason="pynrrd, of the extra `import`, is not installed")
pytest.importorskip("vtkmodules", reason="VTK, of the extra `import`, is not installed")
WHERE = GRIDS["left-handed oblique"]


@pytest.fixture(scope="module")
def slicer(tmp_path_factory):
    path = tmp_path_factory.mktemp("slicer") / "patient.seg.nrrd"
    write_slicerio(path, masks(WHERE), WHERE)
    return path


def run(*arguments):
    return import_organ.main([str(part) for part in arguments])


def test_folder_of_a_slicer_segmentation(slicer, tmp_path, capsys):
    out = tmp_path / "liver"
    holding = ("--attached", "spleen", "--attached-distance", "6")
    assert run(slicer, "--organ", "Liver", "--out", out, *holding, "--no-tetrahedra") == 0
    said, wrong = capsys.readouterr()
    assert wrong == ""
    assert "structure: portal vein (vessel)" in said and "structure: tumor 1 (tumour)" in said
    assert "warning" not in said
    for line in said.splitlines():
        if volumes := re.search(r": (\S+) ml of voxels, (\S+) ml as a mesh", line):
            assert float(volumes[1]) == pytest.approx(float(volumes[2]), rel=0.01)
    text = (out / "organ.yaml").read_text()
    assert "Coordinates of every mesh and place are LPS (x to the patient's left, y to the back" in text
    content = yaml.safe_load(text)
    assert (content["unit"], content["system"], content["frame"]) == ("mm", "LPS", "organ")
    assert [s["kind"] for s in content["structures"]] == ["vessel", "tumour"]
    assert content["structures"][1]["colour"] == list(TYPES["tumor 1"][2])
    organ = load_organ(out)
    assert (organ.name, organ.system) == ("liver", "LPS")
    ends = organ.surface.vertices.min(axis=0), organ.surface.vertices.max(axis=0)
    np.testing.assert_allclose(500.0 * (ends[0] + ends[1]), CENTRE, atol=1.0)
    np.testing.assert_allclose(1e3 * organ.structures[1].mesh.vertices.mean(axis=0), TUMOUR, atol=0.3)
    behind = organ.surface.vertices[organ.attached]  # the spleen lies behind it in y
    assert len(behind) > 5 and (1e3 * behind[:, 1] > CENTRE[1] + 40.0).all()


def test_ras_and_what_is_said_of_attachment(slicer, tmp_path, capsys):
    out = tmp_path / "liver"
    options = ("--coordinates", "RAS", "--name", "Patient 07", "--kind", "tumor 1=other", "--no-tetrahedra")
    assert run(slicer, "--organ", "liver", "--out", out, "--leave-out", "portal vein", *options) == 0
    said = capsys.readouterr().out
    assert "attached: nothing says where the organ is held in place" in said
    assert "spleen: left out, it is outside liver" in said and "portal vein: left out, as asked" in said
    organ = load_organ(out)
    assert (organ.name, organ.system) == ("Patient 07", "RAS")
    assert [(s.name, s.kind) for s in organ.structures] == [("tumor 1", "other")]
    np.testing.assert_allclose(
        1e3 * organ.structures[0].mesh.vertices.mean(axis=0), TUMOUR * [-1, -1, 1], atol=0.3
    )
    assert enclosed_volume(read_mesh(out / "liver.ply", 1e-3).mesh) > 0.0
    assert "# attached:\n#   touching:" in (out / "organ.yaml").read_text()


def test_labels_without_names_are_named_on_the_command_line(tmp_path, capsys):
    write_nibabel(tmp_path / "a.nii.gz", labels(WHERE), WHERE)
    names = ("--label", "1=liver", "--label", "2=vein", "--label", "3=tumour")
    assert (
        run(tmp_path / "a.nii.gz", "--organ", "liver", "--out", tmp_path / "o", *names, "--no-tetrahedra")
        == 0
    )
    organ = load_organ(tmp_path / "o")
    assert [(s.name, s.kind) for s in organ.structures] == [("vein", "vessel"), ("tumour", "tumour")]
    assert "4: left out, it is outside liver" in capsys.readouterr().out
    assert run(tmp_path / "a.nii.gz", "--list") == 0
    said = capsys.readouterr().out
    assert "segments: 4, voxels of 1.5 x 2 x 2.5 mm" in said and "\n1: 5" in said


def test_result_is_checked_and_filled_as_check_organ_does(slicer, tmp_path, capsys):
    assert run(slicer, "--organ", "liver", "--out", tmp_path / "liver") == 0
    said = capsys.readouterr().out
    assert "organ: liver, frame organ\n" in said and "volume mesh: " in said.splitlines()[-1]


def test_folder_with_files_is_left_alone_unless_forced(slicer, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    arguments = (slicer, "--organ", "liver", "--out", tmp_path, "--no-tetrahedra")
    assert run(*arguments) == 2
    assert "expected an empty folder or none, got one with files" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    assert run(*arguments, "--force") == 0
    assert (tmp_path / "notes.txt").read_text() == "mine" and (tmp_path / "organ.yaml").is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--organ", "lever"), "--organ: expected one of the segments 'liver', 'portal vein'"),
        (("--organ", "liver", "--attached", "liver"), "expected other segments than the organ"),
        (("--organ", "liver", "--kind", "tumor 1"), "--kind: expected two words with = between them"),
        (("--organ", "liver", "--kind", "x=y"), "--kind: expected one of the segments"),
        (("--organ", "liver", "--label", "9=y"), "--label: expected a label that has voxels"),
        (("--organ", "liver", "--triangles", "5"), "--triangles: expected 500 to 200000, got 5"),
        (("--organ", "liver", "--attached-distance", "-1"), "--attached-distance: expected above 0"),
    ],
)
def test_what_cannot_be_used_is_one_sentence_and_nothing_is_written(
    slicer, tmp_path, capsys, arguments, words
):
    assert run(slicer, "--out", tmp_path / "new", *arguments) == 2
    wrong = capsys.readouterr().err
    assert wrong.startswith("error: ") and words in wrong and wrong.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_file_that_is_none_is_one_sentence(tmp_path, capsys):
    (tmp_path / "a.seg.nrrd").write_bytes(b"NRRD0004\ntype: unsigned char\n\n")
    assert run(tmp_path / "a.seg.nrrd", "--organ", "liver", "--out", tmp_path / "new") == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_missing_library_is_said(slicer, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reading.importlib.util, "find_spec", lambda name: None)
    assert run(slicer, "--organ", "liver", "--out", tmp_path / "new") == 2
    assert "pip install vtk, or softtissue_estimator with [import]" in capsys.readouterr().err


def test_organ_that_is_too_small_is_refused_by_the_check(tmp_path, capsys):
    drawn = masks(WHERE)
    write_slicerio(tmp_path / "a.seg.nrrd", {"node": drawn["tumor 1"]}, WHERE)
    assert run(tmp_path / "a.seg.nrrd", "--organ", "node", "--out", tmp_path / "new") == 2
    assert "expected an organ of 0.01 to 20 litres" in capsys.readouterr().err


@pytest.mark.parametrize("spacing", [(1.5, 1.5, 1.5), (0.9, 0.9, 3.0)])
@pytest.mark.parametrize("name", ["liver", "openhelp"])
@pytest.mark.skipif(not RECORDED.is_dir(), reason=f"no test data in {RECORDED}")
def test_livers_of_patients_come_back_from_voxels(tmp_path, capsys, name, spacing):
    from estimator.segmentation.voxels import distances, voxelised

    path = PATIENT / "liver.vtk" if name == "liver" else RECORDED / "openhelp" / "liver.stl"
    mask, where = voxelised(path, spacing)
    write_slicerio(tmp_path / "a.seg.nrrd", {"liver": mask}, where)
    assert run(tmp_path / "a.seg.nrrd", "--organ", "liver", "--out", tmp_path / "o", "--no-tetrahedra") == 0
    truth, found = read_mesh(path, 1e-3).mesh, load_organ(tmp_path / "o").surface
    assert enclosed_volume(found) == pytest.approx(abs(enclosed_volume(truth)), rel=0.01)
    there, back = distances(found, truth), distances(truth, found)
    diagonal = 1e-3 * np.linalg.norm(spacing)
    # A fold of the given surface inside it, or a sheet thinner than a voxel, has no voxels.
    assert there.max() < diagonal and np.quantile(back, 0.999) < diagonal
    assert max(there.mean(), back.mean()) < 0.25 * diagonal
