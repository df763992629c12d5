"""Lists of labelled points: CSV and both forms of 3D Slicer, in LPS and RAS, and damaged ones.

Slicer itself cannot run here; the texts below follow its documentation and the files that its versions write.
"""

import json
import logging

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.markups_json import write_markups_json
from softtissue_training.experiments.point_lists import read_points

COLUMNS = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
LPS_MM = np.array([[-19.9067, 13.9347, 29.442970822281154], [81.75, -42.9415, -9.5]])
RAS_MM = LPS_MM * [-1.0, -1.0, 1.0]  # right is minus left, anterior is minus posterior

SLICER_4_10 = (
    "# Markups fiducial file version = 4.10\n# CoordinateSystem = 0\n"
    + COLUMNS
    + "vtkMRMLMarkupsFiducialNode_0,"
    "19.9067,-13.9347,29.442970822281154,0,0,0,1,1,1,0,dome,,vtkMRMLScalarVolumeNode1\n"
    "vtkMRMLMarkupsFiducialNode_1,-81.75,42.9415,-9.5,0,0,0,1,0,0,1,tip,,\n"
)
SLICER_4_13 = (
    "# Markups fiducial file version = 4.13\n# CoordinateSystem = LPS\n"
    + COLUMNS
    + "0,-19.9067,13.9347,29.442970822281154,0,0,0,1,1,1,0,dome,,\n1,81.75,-42.9415,-9.5,0,0,0,1,1,1,0,tip,,\n"
)
SLICER_5 = (
    "# Markups fiducial file version = 5.2\n# CoordinateSystem = LPS\n"
    + COLUMNS
    + '1,-19.9067,13.9347,29.442970822281154,0,0,0,1,1,1,0,"dome, ""upper""",,\r,2,0\n'
    + "2,0,0,0,0,0,0,1,1,1,0,never placed,,,0,0\n"
    + "3,81.75,-42.9415,-9.5,0,0,0,1,0,0,0,,seen,vtkMRMLModelNode4,2,0\n"
)


def markups(**changes):
    point = {"id": "1", "label": "dome", "position": LPS_MM[0].tolist()}
    other = {"label": "tip", "position": LPS_MM[1].tolist(), "positionStatus": "defined", "visibility": False}
    unplaced = {"label": "not yet", "positionStatus": "undefined"}
    turned = {**point, "orientation": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm"}
    markup["controlPoints"] = [turned, unplaced, other]
    markup = {key: value for key, value in {**markup, **changes}.items() if value is not None}
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/.../markups-schema-v1.0.3.json#"
    return {"@schema": schema, "markups": [markup]}


def read(tmp_path, name, content, unit_m=None, system="LPS"):
    path = tmp_path / name
    if isinstance(content, dict | list):
        content = json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_points(path, unit_m, system)


@pytest.mark.parametrize("system", ["LPS", "RAS"])
@pytest.mark.parametrize("content", [SLICER_4_10, SLICER_4_13], ids=["4.10", "4.13"])
def test_fcsv_of_every_version_gives_the_same_points(tmp_path, content, system):
    found = read(tmp_path, "markers.fcsv", content, system=system)
    assert found.labels == ("dome", "tip")
    expected = LPS_MM if system == "LPS" else RAS_MM
    np.testing.assert_allclose(found.points, expected / 1000.0, rtol=0.0, atol=1e-15)


def test_fcsv_of_slicer_5_has_more_columns_than_it_says(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        found = read(tmp_path, "markers.fcsv", SLICER_5)
    assert found.labels == ('dome, "upper"', "3")
    np.testing.assert_allclose(found.points, LPS_MM / 1000.0, rtol=0.0, atol=1e-15)
    assert "1 without a defined position" in caplog.text


def test_windows_line_ends_and_a_byte_order_mark_are_no_content(tmp_path):
    content = b"\xef\xbb\xbf" + SLICER_4_13.replace("\n", "\r\n").encode()
    found = read(tmp_path, "markers.FCSV", content)
    assert found.labels == ("dome", "tip")


@pytest.mark.parametrize("system", ["LPS", "RAS"])
@pytest.mark.parametrize(("stated", "positions"), [("LPS", LPS_MM), ("RAS", RAS_MM), (None, LPS_MM)])
def test_markups_in_both_systems(tmp_path, stated, positions, system):
    content = markups(coordinateSystem=stated)
    for point, position in zip(content["markups"][0]["controlPoints"][::2], positions, strict=True):
        point["position"] = position.tolist()
    found = read(tmp_path, "markers.mrk.json", content, system=system)
    assert found.labels == ("dome", "tip")
    expected = LPS_MM if system == "LPS" else RAS_MM
    np.testing.assert_allclose(found.points, expected / 1000.0, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("unit", "unit_m"),
    [(None, 1e-3), ("um", 1e-6), (["mm", "UCUM", "millimeter"], 1e-3), ("m", 1.0), ("cm", 1e-2)],
)
def test_unit_of_markups_is_that_of_the_file(tmp_path, unit, unit_m):
    found = read(tmp_path, "markers.mrk.json", markups(coordinateUnits=unit), unit_m=123.0)
    np.testing.assert_allclose(found.points, LPS_MM * unit_m, rtol=1e-14)


def test_several_markups_are_joined_and_corners_of_regions_left_out(tmp_path):
    content = markups()
    line = {
        "type": "Line",
        "coordinateSystem": "RAS",
        "controlPoints": [{"label": "L-1", "position": [1, 2, 3]}, {"position": [4, 5, 6]}],
    }
    region = {"type": "ROI", "center": [0, 0, 0], "controlPoints": [{"label": "R", "position": [7, 8, 9]}]}
    content["markups"] += [region, line]
    found = read(tmp_path, "all.json", content)
    assert found.labels == ("dome", "tip", "L-1", "4")
    np.testing.assert_allclose(found.points[2:] * 1000.0, [[-1, -2, 3], [-4, -5, 6]], atol=1e-12)


CSV = {
    "header": "label,x,y,z\ndome,-19.9067,13.9347,29.442970822281154\ntip,81.75,-42.9415,-9.5\n",
    "no header": "dome,-19.9067,13.9347,29.442970822281154\n\ntip,81.75,-42.9415,-9.5",
    "other order": "Z,note,Y,X,Name\n29.442970822281154,,13.9347,-19.9067,dome\n-9.5,?,-42.9415,81.75,tip\n",
    "semicolons": "# from a spreadsheet\nlabel;x;y;z\ndome;-19,9067;13,9347;29,442970822281154\n"
    "tip;81,75;-42,9415;-9,5",
    "tabs": "dome\t-19.9067\t13.9347\t29.442970822281154\ntip\t81.75\t-42.9415\t-9.5\n",
    "Slicer's LPS": "label,l,p,s,defined,selected,visible,locked,description\n"
    "dome,-19.9067,13.9347,29.442970822281154,1,1,1,0,\nlost,0,0,0,0,1,1,0,\ntip,81.75,-42.9415,-9.5,1,1,1,0,\n",
    "Slicer's RAS": "label,r,a,s\ndome,19.9067,-13.9347,29.442970822281154\ntip,-81.75,42.9415,-9.5\n",
    "of pandas": ",label,x,y,z\n0,dome,-19.9067,13.9347,29.442970822281154\n1,tip,81.75,-42.9415,-9.5\n",
    "fcsv by content": SLICER_4_10,
}


@pytest.mark.parametrize("content", CSV.values(), ids=CSV.keys())
def test_csv_in_every_form(tmp_path, content):
    found = read(tmp_path, "markers.csv", content, unit_m=1e-3)
    assert found.labels == ("dome", "tip")
    np.testing.assert_allclose(found.points, LPS_MM / 1000.0, rtol=0.0, atol=1e-15)


def test_axes_without_a_name_are_those_of_the_organ(tmp_path):
    found = read(tmp_path, "markers.csv", CSV["header"], unit_m=1.0, system="RAS")
    np.testing.assert_array_equal(found.points, LPS_MM)
    found = read(tmp_path, "markers.csv", CSV["Slicer's LPS"], unit_m=1.0, system="RAS")
    np.testing.assert_array_equal(found.points, RAS_MM)


def test_points_without_labels_are_numbered(tmp_path):
    assert read(tmp_path, "markers.tsv", "1\t2\t3\n4\t5\t6\n", unit_m=1.0).labels == ("1", "2")


@pytest.mark.parametrize("system", ["LPS", "RAS"])
@pytest.mark.parametrize(("name", "write"), [("a.fcsv", write_fcsv), ("a.mrk.json", write_markups_json)])
def test_written_points_are_read_again(tmp_path, name, write, system):
    rng = np.random.default_rng(3)
    points = LabelledPoints(('a, "b"', "ü", "3"), rng.normal(size=(3, 3)))
    write(tmp_path / name, points, system)
    same = read_points(tmp_path / name, None, system)
    assert same.labels == points.labels
    np.testing.assert_allclose(same.points, points.points, rtol=1e-15)
    mirrored = read_points(tmp_path / name, None, "RAS" if system == "LPS" else "LPS")
    np.testing.assert_allclose(mirrored.points, points.points * [-1.0, -1.0, 1.0], rtol=1e-15)


def test_written_markups_have_what_the_schema_requires(tmp_path):
    write_markups_json(
        tmp_path / "a.mrk.json", LabelledPoints(("p",), np.ones((1, 3))), "LPS", name="targets"
    )
    content = json.loads((tmp_path / "a.mrk.json").read_text())
    (markup,) = content["markups"]
    assert content["@schema"].endswith("markups-schema-v1.0.3.json#")
    assert (markup["type"], markup["name"], markup["coordinateUnits"]) == ("Fiducial", "targets", "mm")
    assert markup["controlPoints"][0]["position"] == [1000.0, 1000.0, 1000.0]
    assert markup["controlPoints"][0]["positionStatus"] == "defined"


HEADER = "# Markups fiducial file version = 4.13\n# CoordinateSystem = LPS\n" + COLUMNS
MISTAKES = [
    ("a.csv", "", "expected at least one point, got an empty file"),
    ("a.csv", "label,x,y,z\n", "expected at least one point, got none"),
    ("a.csv", "a,b\n1,2\n", "expected the columns label, x, y, z, or a header that names x, y and z, got 2"),
    ("a.csv", "label,x,y,z\na,1,2\n", "line 2: expected 4 columns, got 3"),
    ("a.csv", "a,1,2,three\n", "line 1: expected three finite coordinates, got '1, 2, three'"),
    ("a.csv", "a,1,2,nan\n", "line 1: expected three finite coordinates"),
    ("a.csv", "a,1,2,1e999\n", "line 1: expected three finite coordinates"),
    ("a.csv", b"\xff\xfe\x00\xd8\x00\x01", "expected text"),
    ("a.csv", '"' + "x" * 140_000 + ",1,2,3\n", "expected rows of a table"),
    ("a.txt", "a,1,2,3\n", "expected one of .csv, .tsv, .fcsv, .mrk.json, .json, got .txt"),
    ("a.fcsv", "", "expected a line '# CoordinateSystem = LPS'.*got no such line"),
    ("a.fcsv", HEADER.replace("LPS", "2"), "expected a line '# CoordinateSystem = LPS'.*got '2'"),
    ("a.fcsv", HEADER, "expected at least one point, got none"),
    ("a.fcsv", HEADER + "1,2,3\n", "line 4: expected three finite coordinates, got '2, 3, '"),
    ("a.fcsv", HEADER.replace("id,x,y", "id,u,v") + "1,2,3\n", "expected columns x, y and z"),
    ("a.json", "{", "expected Slicer's markups as JSON"),
    ("a.json", "[" * 100_000, "expected Slicer's markups as JSON"),
    ("a.json", '{"markups": ' + "1" * 5000 + "}", "expected Slicer's markups as JSON"),
    ("a.json", [], "expected Slicer's markups, got JSON without a list 'markups'"),
    ("a.json", {"markups": [1]}, "expected Slicer's markups, got JSON without a list 'markups'"),
    ("a.json", {"markups": []}, "expected at least one point, got none"),
    ("a.json", {"@schema": "markups-schema-v2.0.0.json#", "markups": []}, "schema version 1"),
    ("a.json", markups(coordinateSystem="IJK"), "markup 1, coordinateSystem: expected LPS or RAS, got 'IJK'"),
    (
        "a.json",
        markups(coordinateUnits="inch"),
        "markup 1, coordinateUnits: expected mm, um, cm or m, got 'inch'",
    ),
    ("a.json", markups(controlPoints=3), "controlPoints: expected a list of objects"),
    (
        "a.json",
        markups(controlPoints=[{"label": "a"}]),
        "point 1: expected three finite coordinates, got None",
    ),
    (
        "a.json",
        markups(controlPoints=[{"position": [1, 2]}]),
        r"expected three finite coordinates, got \[1, 2\]",
    ),
    ("a.json", markups(controlPoints=[{"position": [1, 2, "3"]}]), "expected three finite coordinates"),
    ("a.json", markups(controlPoints=[{"position": [1, 2, 10**400]}]), "expected three finite coordinates"),
    (
        "a.json",
        markups(controlPoints=[{"position": [1, 2, float("nan")]}]),
        "expected three finite coordinates",
    ),
]


@pytest.mark.parametrize(("name", "content", "message"), MISTAKES, ids=lambda value: str(value)[:30])
def test_mistakes_are_one_sentence(tmp_path, name, content, message):
    with pytest.raises(InvalidInputError, match=message) as caught:
        read(tmp_path, name, content, unit_m=1e-3)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_unit_and_system_are_named(tmp_path):
    with pytest.raises(InvalidInputError, match="expected a file, found none"):
        read_points(tmp_path / "a.csv", 1e-3, "LPS")
    with pytest.raises(InvalidInputError, match="expected a unit beside a CSV file"):
        read(tmp_path, "a.csv", "a,1,2,3\n")
    with pytest.raises(InvalidInputError, match="coordinate system: expected LPS or RAS, got 'LAS'"):
        read_points(tmp_path / "a.csv", 1e-3, "LAS")


@pytest.mark.parametrize("name", ["a.csv", "a.fcsv", "a.mrk.json"])
def test_damaged_files_raise_nothing_else(tmp_path, name):
    whole = {"a.csv": CSV["Slicer's LPS"], "a.fcsv": SLICER_5, "a.mrk.json": json.dumps(markups())}[
        name
    ].encode()
    rng = np.random.default_rng(11)
    damaged = [whole[:end] for end in range(0, len(whole), 17)]
    for _ in range(100):
        flipped = bytearray(whole)
        for place in rng.integers(len(whole), size=3):
            flipped[place] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    outcomes = set()
    for content in damaged:
        try:
            outcomes.add(bool(np.isfinite(read(tmp_path, name, content, unit_m=1e-3).points).all()))
        except SoftTissueError as error:
            outcomes.add("one sentence" if "\n" not in str(error) else "several lines")
    assert outcomes == {True, "one sentence"}


MARKED = [b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff"]


@pytest.mark.parametrize("mark", MARKED, ids=["UTF-8", "UTF-16 LE", "UTF-16 BE"])
@pytest.mark.parametrize("name", ["a.csv", "a.fcsv", "a.mrk.json"])
def test_marks_of_encodings_are_no_content(tmp_path, name, mark):
    text = {"a.csv": CSV["header"], "a.fcsv": SLICER_4_10, "a.mrk.json": json.dumps(markups())}[name]
    encoding = {2: "utf-16-le" if mark[0] == 0xFF else "utf-16-be", 3: "utf-8"}[len(mark)]
    found = read(tmp_path, name, mark + text.encode(encoding), unit_m=1e-3)
    assert found.labels == ("dome", "tip")
    np.testing.assert_allclose(found.points, LPS_MM / 1000.0, rtol=0.0, atol=1e-15)


def test_fcsv_with_decimal_commas_is_refused(tmp_path):
    with pytest.raises(
        InvalidInputError, match="line 4: expected at most 16 fields, got 17; numbers need decimal"
    ):
        read(
            tmp_path,
            "a.fcsv",
            SLICER_4_13.replace("-19.9067,13.9347,29.442970822281154", "-19,9067,13,9347,29,44"),
        )
