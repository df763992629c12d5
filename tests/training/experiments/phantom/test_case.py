"""Case folders of the phantom experiment: what is read from them, and what is refused."""

import igl
import numpy as np
import pytest
import trimesh
import yaml

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.phantom.case import load_phantom_case
from training.phantom_cases import MARKERS_M, bend, ellipsoid, seen_points, write_case, write_table


def test_files_of_the_usual_names_need_no_case_file(tmp_path):
    case = load_phantom_case(write_case(tmp_path / "my case"))
    assert case.name == "my case" and case.organ.name == "Ellipsoid"
    assert case.markers.labels == ("M1", "M2", "M3", "M4")
    np.testing.assert_allclose(case.markers.before, MARKERS_M, atol=1e-9)
    np.testing.assert_allclose(case.markers.displacement, bend(MARKERS_M), atol=1e-9)
    np.testing.assert_allclose(case.correspondences.before, seen_points(13), atol=1e-8)
    np.testing.assert_allclose(case.correspondences.displacement, bend(seen_points(13)), atol=1e-8)
    assert case.sigma_m == 0.001 and case.surface_after is None and case.truth is None
    areas = vertex_areas(case.organ.surface)
    assert areas[case.organ.attached].sum() / areas.sum() == pytest.approx(0.15, abs=0.01)


def test_visible_part_of_the_surface_after_is_taken(tmp_path):
    case = load_phantom_case(write_case(tmp_path, correspondences=None, surface=True))
    points, normals = case.surface_after.points, case.surface_after.normals
    assert case.correspondences is None and case.sigma_m == pytest.approx(0.0005)
    organ = ellipsoid()
    moved = SurfaceMesh(organ.vertices + bend(organ.vertices), organ.faces)
    assert igl.point_mesh_squared_distance(points, moved.vertices, moved.faces)[0].max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    outside = signed_distance(moved, points + 0.001 * normals)
    assert outside.min() > 0.0005  # normals point outwards
    # The nearest 40 % of the surface around (20, 0, 45) mm: most of the upper side, nothing below.
    assert points[:, 2].min() > -0.02 and points[:, 2].max() > 0.03


def test_surface_after_may_be_points(tmp_path):
    folder = write_case(tmp_path, correspondences=None)
    points = seen_points(50)
    (folder / "surface_after.csv").write_text("\n".join(",".join(map(str, p)) for p in 1e3 * points))
    seen = load_phantom_case(folder).surface_after
    np.testing.assert_allclose(seen.points, points, atol=1e-9)
    assert seen.normals is None


def test_case_file_says_everything(tmp_path):
    folder = write_case(tmp_path)
    (folder / "correspondences.csv").rename(folder / "mine.csv")
    write_table(folder / "mine.csv", 1e-3 * seen_points(6))  # metres, as the unit below says
    write_fcsv(folder / "a.fcsv", LabelledPoints(("p",), MARKERS_M[:1]), "LPS")
    write_fcsv(folder / "b.fcsv", LabelledPoints(("p",), MARKERS_M[:1] + 0.001), "LPS")
    content = {
        "name": "Mine",
        "unit": "m",
        "system": "LPS",
        "sigma": 0.002,
        "tracking_noise": 0.0005,
        "correspondences": "mine.csv",
        "markers": {"before": "a.fcsv", "after": "b.fcsv"},
        "spread": {"share": 0.185},
    }
    text = yaml.safe_dump(content)
    (folder / "case.yaml").write_text(text)
    (folder / "mine.csv").write_text(
        "x,y,z,x_after,y_after,z_after\n"
        + "\n".join(",".join(map(str, [*p, *(p + 0.001)])) for p in seen_points(6))
    )
    case = load_phantom_case(folder)
    assert (case.name, case.sigma_m, case.spread_share, case.tracking_noise_m) == (
        "Mine",
        0.002,
        0.185,
        0.0005,
    )
    np.testing.assert_allclose(case.correspondences.displacement, 0.001, atol=1e-9)
    assert case.markers.labels == ("p",)


MISTAKES = [
    ({"unit": "cm"}, "unit: expected mm or m, got 'cm'"),
    ({"system": "XYZ"}, "system: expected LPS or RAS, got 'XYZ'"),
    ({"sigma": -1}, "sigma: expected a number from 0.01 to 50, got -1"),
    ({"colour": "red"}, "colour: unknown key, expected one of name, unit"),
    ({"markers": "none.csv"}, "markers: expected a file, found none"),
    ({"markers": {"before": "markers_before.fcsv"}}, "markers: expected before and after"),
    ({"markers": {"first": "x"}}, "markers.first: unknown key, expected one of before, after"),
    ({"spread": 0.2}, "spread: expected a mapping with share, got 0.2"),
    ({"spread": {"share": 18.5}}, "spread.share: expected a number from 0.001 to 1, got 18.5"),
    ({"surface_after": "none.stl"}, "surface_after: expected a file, found none"),
    ({"visible": {"centre": [1, 2], "share": 0.2}}, "visible.centre: expected 3 numbers"),
    ({"visible": {"centre": [1, 2, 3]}}, "visible.share: expected a number from 0.001 to 1, got nothing"),
    ({"name": 7}, "name: expected text, got 7"),
    ("- a\n- b\n", "expected keys name, unit"),
    ("a: [", "expected YAML"),
]


@pytest.mark.parametrize(("content", "words"), MISTAKES)
def test_mistakes_are_one_sentence_that_names_the_key(tmp_path, content, words):
    folder = write_case(tmp_path)
    (folder / "case.yaml").write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    with pytest.raises(SoftTissueError) as caught:
        load_phantom_case(folder)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(SoftTissueError, match="expected a folder, found none"):
        load_phantom_case(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SoftTissueError, match="expected a folder with organ.yaml"):
        load_phantom_case(tmp_path / "empty")
    folder = write_case(tmp_path / "a")
    (folder / "correspondences.csv").unlink()
    with pytest.raises(SoftTissueError, match="expected correspondences, or the organ's surface after"):
        load_phantom_case(folder)
    (folder / "markers_after.mrk.json").unlink()
    with pytest.raises(
        SoftTissueError, match="markers: expected markers_before and markers_after, found only"
    ):
        load_phantom_case(folder)
    (folder / "markers_before.fcsv").unlink()
    with pytest.raises(
        SoftTissueError, match="markers: expected markers_before and markers_after .* found none"
    ):
        load_phantom_case(folder)


def test_two_files_of_one_usual_name_are_refused(tmp_path):
    folder = write_case(tmp_path, surface=True)
    (folder / "surface_after.stl").write_bytes(b"")
    with pytest.raises(
        SoftTissueError, match="one file surface_after, found surface_after.ply, surface_after.stl"
    ):
        load_phantom_case(folder)


def test_points_in_the_other_system_are_recognised(tmp_path):
    # The same numbers, but the meshes are said to be RAS: Slicer's lists, which know better, come out mirrored.
    folder = write_case(tmp_path)
    organ = ellipsoid()
    shifted = 1e3 * (organ.vertices + np.array([0.1, 0.1, 0.0]))
    trimesh.Trimesh(shifted, organ.faces, process=False).export(folder / "organ.ply")
    (folder / "organ.yaml").write_text(yaml.safe_dump({"unit": "mm", "surface": "organ.ply"}))
    moved = LabelledPoints(("M1", "M2", "M3", "M4"), MARKERS_M + np.array([0.1, 0.1, 0.0]))
    write_fcsv(folder / "markers_before.fcsv", moved, "LPS")
    (folder / "case.yaml").write_text("system: RAS\n")
    with pytest.raises(
        SoftTissueError, match=r"markers before: expected them inside .* \(LPS, RAS\) is probably wrong"
    ):
        load_phantom_case(folder)


def test_a_system_that_the_surface_contradicts_is_refused(tmp_path):
    folder = write_case(tmp_path)
    surface = folder / yaml.safe_load((folder / "organ.yaml").read_text())["surface"]
    content = surface.read_bytes().replace(b"element vertex", b"comment SPACE=RAS\nelement vertex", 1)
    surface.write_bytes(content)
    with pytest.raises(
        SoftTissueError,
        match="system: expected RAS, as the file of the organ's surface states, got LPS",
    ):
        load_phantom_case(folder)


def test_correspondences_away_from_the_surface_are_refused(tmp_path):
    folder = write_case(tmp_path)
    write_table(folder / "correspondences.csv", 0.5 * seen_points(5))
    with pytest.raises(SoftTissueError, match="within 10 mm of the organ's surface, got . \\d+ mm away"):
        load_phantom_case(folder)
