"""Rows of CSV tables of points: words as flags, comments and labels, and rows that cannot be meant."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.point_lists import read_points


def read(tmp_path, name, content, unit_m, system="LPS"):
    (tmp_path / name).write_text(content, encoding="utf-8")
    return read_points(tmp_path / name, unit_m, system)


@pytest.mark.parametrize("yes", ["1", "True", "TRUE", "yes", "1.0", "WAHR"])
@pytest.mark.parametrize("no", ["0", "False", "no", "0.0", "FALSCH"])
def test_flags_may_be_words(tmp_path, yes, no):
    content = f"label,x,y,z,defined\nA,1,2,3,{yes}\nB,0,0,0,{no}\nC,4,5,6,{yes}\n"
    assert read(tmp_path, "a.csv", content, 1.0).labels == ("A", "C")


def test_labels_and_comments_that_begin_with_a_hash(tmp_path):
    content = 'label,x,y,z\n# two left out:\n# A,1,2,3\n# B,1,2,3\n"#1",4,5,6\n##\n#end\n'
    found = read(tmp_path, "a.csv", content, 1.0)
    assert found.labels == ("#1",)
    np.testing.assert_array_equal(found.points, [[4, 5, 6]])


@pytest.mark.parametrize("header", ["# z, y, x", "#label,z,y,x\n", "# from numpy\n# z,y,x"])
def test_a_comment_above_the_rows_may_be_the_header(tmp_path, header):
    row = "A,1,2,3" if "label" in header else "1,2,3"
    found = read(tmp_path, "a.csv", f"{header}\n{row}\n", 1.0)
    np.testing.assert_array_equal(found.points, [[3, 2, 1]])
    found = read(tmp_path, "a.csv", "# r,a,s\n1,2,3\n", 1.0, "LPS")
    np.testing.assert_array_equal(found.points, [[-1, -2, 3]])


@pytest.mark.parametrize("rows", ["A,1,2,3,\n", "A,1,2,3,,,\n"])
def test_separators_at_the_end_of_a_row_do_not_matter(tmp_path, rows):
    found = read(tmp_path, "a.csv", "label,x,y,z\n" + rows, 1.0)
    np.testing.assert_array_equal(found.points, [[1, 2, 3]])


WRONG_ROWS = {
    "decimal commas between commas": ("label,x,y,z\nA,12,500,-3,250,7,000\n", "line 2: expected 4 columns, got 7"),
    "the same without a header": ("1,2,3\n12,5,3,2,7,1\n", "line 2: expected 3 columns, got 6; numbers with"),
    "one field more": ("x,y,z\n1,2,3\n1,2,3,4\n", "line 3: expected 3 columns, got 4"),
    "one field less": ("x,y,z\n1,2,3\n1,2\n", "line 3: expected 3 columns, got 2"),
    "a label with a comma": ("label;x;y;z\nA;1;2;3\nB;1;2;3;4\n", "line 3: expected 4 columns, got 5"),
    "a flag that is none": ("x,y,z,defined\n1,2,3,maybe\n", "line 2: expected defined to be 1 or 0, .* got 'maybe'"),
    "a flag that is empty": ("x,y,z,defined\n1,2,3,1\n1,2,3,\n", "line 3: expected defined to be .* got ''"),
    "a label that begins with #": ("label,x,y,z\n#1,1,2,3\nA,1,2,3\n", "line 2: expected a comment or a row"),
    "the same in the last row": ("A;1;2;3\n#2;1;2;3\n", "line 2: expected a comment or a row"),
    "points and commas": ("x;y;z\n1.234;2,5;3\n", "line 2: .* got both, '1.234, 2,5, 3'"),
    "points and commas in two rows": ("x;y;z\n1,2;2;3\n1.2;2;3\n", "line 3: expected decimal points or decimal commas"),
    "thousands": ("x;y;z\n1.234,5;2;3\n", "line 2: expected decimal points or decimal commas"),
    "underscores": ("x;y;z\n1_000;2;3\n", "line 2: expected three finite coordinates"),
    "a column twice": ("x,y,z,x\n1,2,3,4\n", "line 1: expected each column once, got 'x' again"),
    "quoted decimal commas": ('label,x,y,z\nA,"1,5",2,3\n', "line 2: expected three finite coordinates"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_ROWS)
def test_rows_that_cannot_be_meant_are_named(tmp_path, name):
    content, message = WRONG_ROWS[name]
    with pytest.raises(InvalidInputError, match=message):
        read(tmp_path, "a.csv", content, 1.0)
