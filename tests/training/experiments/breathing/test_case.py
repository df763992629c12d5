"""Case folders of the breathing experiment: what is read of them, and what is refused."""

import shutil

import numpy as np
import pytest
import trimesh
import yaml

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.cli import main
from softtissue_training.experiments.breathing.case import bundled_case, load_case

AXES = np.array([0.06, 0.04, 0.05])  # m, of an ellipsoid
SHIFT = np.array([0.01, 0.02, -0.03])


def ellipsoid(scale=1.0, shift=(0.0, 0.0, 0.0), subdivisions=3):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return trimesh.Trimesh(1e3 * (scale * ball.vertices * AXES + shift), ball.faces, process=False)


def write_case(folder, **changes):
    """A case in millimetres whose second state is shifted; `changes` replace keys, None removes them."""
    folder.mkdir(exist_ok=True)
    ellipsoid().export(folder / "before.ply")
    ellipsoid(shift=SHIFT).export(folder / "after.ply")
    ellipsoid(0.3, subdivisions=2).export(folder / "vein_before.ply")
    ellipsoid(0.3, SHIFT, subdivisions=2).export(folder / "vein_after.ply")
    organ = {
        "unit": "mm",
        "surface": "before.ply",
        "structures": [{"name": "vein", "kind": "vessel", "mesh": "vein_before.ply"}],
        "attached": {"spheres": [{"centre": [60, 0, 0], "radius": 20}]},
    }
    (folder / "organ.yaml").write_text(yaml.safe_dump(organ))
    content = {
        "unit": "mm",
        "system": "LPS",
        "surface_after": "after.ply",
        "structures_after": [{"name": "vein", "mesh": "vein_after.ply"}],
    } | changes
    (folder / "case.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return folder


def test_case_is_read_in_metres(tmp_path):
    case = load_case(write_case(tmp_path))
    np.testing.assert_allclose(case.surface.vertices.mean(axis=0), SHIFT, atol=1e-4)
    np.testing.assert_allclose(np.ptp(case.surface.vertices, axis=0), 2 * AXES, rtol=0.01)
    np.testing.assert_allclose(case.structures["vein"].vertices.mean(axis=0), SHIFT, atol=1e-4)
    assert [structure.name for structure in case.compared] == ["vein"]
    assert case.alignment == "icp" and case.truth is None


@pytest.mark.parametrize(
    ("changes", "front"),
    [
        ({"system": "LPS"}, [0, -1, 0]),
        ({"system": "RAS"}, [0, 1, 0]),
        ({"system": None, "anterior": [3, 0, -4]}, [0.6, 0, -0.8]),
    ],
)
def test_front_is_where_the_coordinate_system_says(tmp_path, changes, front):
    np.testing.assert_allclose(load_case(write_case(tmp_path, **changes)).anterior, front)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": None}, "unit: expected mm or m, got None"),
        ({"unit": "cm"}, "unit: expected mm or m, got 'cm'"),
        ({"unit": "m"}, "with unit m; another unit"),
        ({"system": None}, "either system .* got neither"),
        ({"anterior": [0, 1, 0]}, "either system .* got both"),
        ({"system": "RPI"}, "system: expected LPS or RAS, got 'RPI'"),
        ({"system": None, "anterior": [0, 0, 0]}, "anterior: expected a direction"),
        ({"system": None, "anterior": [0, 1]}, "anterior: expected 3 numbers"),
        ({"system": None, "anterior": [-1e308, -1, 0]}, "anterior: expected numbers of at most 1e.09"),
        ({"alignment": "cpd"}, "alignment: expected icp or none, got 'cpd'"),
        ({"surface_after": None}, "surface_after: expected the name of a file"),
        ({"surface_after": "nothing.ply"}, "surface_after: expected a file, found none"),
        ({"structures_after": []}, "structures_after: expected at least one structure"),
        ({"structures_after": "vein"}, "structures_after: expected a list"),
        (
            {"structures_after": [{"name": "artery", "mesh": "vein_after.ply"}]},
            r"structures_after\[0\].name: .*\(vein\), got 'artery'",
        ),
        (
            {"structures_after": [{"name": "vein"}]},
            r"structures_after\[0\].mesh: expected the name of a file",
        ),
        (
            {"structures_after": [{"name": "vein", "mesh": "vein_after.ply"} for _ in range(2)]},
            "each structure once",
        ),
        ({"surface": "after.ply"}, "surface: unknown key, expected one of name, unit"),
        ({"truth": "organ.yaml"}, "expected an NPZ file"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, changes, message):
    write_case(tmp_path, **changes)
    with pytest.raises(SoftTissueError, match=message) as caught:
        load_case(tmp_path)
    assert "\n" not in str(caught.value)


def test_truth_of_a_wrong_shape_is_refused(tmp_path):
    write_case(tmp_path, truth="truth.npz")
    np.savez(
        tmp_path / "truth.npz", before=np.zeros((4, 3)), after=np.zeros((5, 3)), part=np.full(4, "inside")
    )
    with pytest.raises(SoftTissueError, match=r"got \(4, 3\), \(5, 3\) and \(4,\)"):
        load_case(tmp_path)
    np.savez(
        tmp_path / "truth.npz",
        before=np.zeros((4, 3)),
        after=np.full((4, 3), np.nan),
        part=np.full(4, "inside"),
    )
    with pytest.raises(SoftTissueError, match="finite positions"):
        load_case(tmp_path)


def test_command_refuses_a_wrong_folder_with_a_sentence(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert main(["evaluate", "breathing", str(tmp_path), *out]) == 2
    assert "expected a folder with case.yaml, found none" in capsys.readouterr().err
    case = write_case(tmp_path / "case")
    assert main(["evaluate", "breathing", str(case), *out, "--correspondences", "cpd,guess"]) == 2
    assert "each once, got 'cpd,guess'" in capsys.readouterr().err
    assert main(["evaluate", "breathing", str(case), *out, "--correspondences", "true"]) == 2
    assert "with the true displacement of its surface" in capsys.readouterr().err


@pytest.fixture(scope="module")
def bundled():
    return load_case(bundled_case())


def test_bundled_case_has_a_truth_that_fits_its_surfaces(bundled):
    truth = bundled.truth
    assert set(truth.part) == {"inside", "surface", "portal vein", "hepatic veins", "tumour"}
    for part, before, after in [("surface", bundled.organ.surface, bundled.surface)] + [
        (structure.name, structure.mesh, bundled.structures[structure.name]) for structure in bundled.compared
    ]:
        of_part = truth.part == part
        for points, mesh in ((truth.before[of_part], before), (truth.after[of_part], after)):
            distance = np.abs(signed_distance(mesh, points[::20]))
            # Half a millimetre is the standard deviation of the segmentation; tips of vessels may be lost in it.
            assert np.median(distance) < 0.0005 and np.percentile(distance, 90) < 0.0015


def test_bundled_diaphragm_moves_down_by_two_centimetres(bundled):
    # Between the scans' frames lies a rigid motion of a few centimetres that the experiment has to find.
    truth = bundled.truth
    moved = np.linalg.norm(truth.after - truth.before, axis=1)
    assert 0.02 < moved.max() < 0.07
    assert 0.01 < bundled.organ.attached.mean() < 0.1


def test_bundled_files_are_small():
    assert sum(path.stat().st_size for path in bundled_case().iterdir()) < 3e6


def test_case_may_lie_anywhere(tmp_path, bundled):
    shutil.copytree(bundled_case(), tmp_path / "copy")
    assert load_case(tmp_path / "copy").organ.digest == bundled.organ.digest
