"""Points before and after from one table or from two lists."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.fcsv import write_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.paired_points import read_pair_of_lists, read_table_of_pairs

BEFORE_M = np.array([[0.001, 0.002, 0.003], [-0.004, 0.0055, 0.006]])
AFTER_M = np.array([[0.007, 0.008, 0.009], [0.010, -0.011, 0.012]])


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3,7,8,9\n-4,5.5,6,10,-11,12\n",
        "a,1,2,3,7,8,9\nb,-4,5.5,6,10,-11,12\n",
        "# by hand\nx_after,y_after,z_after,label,x,y,z\n\n7,8,9,a,1,2,3\n10,-11,12,b,-4,5.5,6\n",
        "\ufeffName;X;Y;Z;X_after;Y_after;Z_after\na;1;2;3;7;8;9\nb;-4;5,5;6;10;-11;12\n",
        "x\ty\tz\tx_after\ty_after\tz_after\n1\t2\t3\t7\t8\t9\n-4\t5.5\t6\t10\t-11\t12\n",
    ],
)
def test_table_is_read_by_its_columns(tmp_path, text):
    (tmp_path / "pairs.csv").write_text(text, encoding="utf-8")
    pairs = read_table_of_pairs(tmp_path / "pairs.csv", 0.001, "LPS", "pairs")
    np.testing.assert_allclose(pairs.before, BEFORE_M, atol=1e-12)
    np.testing.assert_allclose(pairs.after, AFTER_M, atol=1e-12)
    np.testing.assert_allclose(pairs.displacement, AFTER_M - BEFORE_M, atol=1e-12)
    assert pairs.labels in {("1", "2"), ("a", "b")}


def test_lists_are_paired_by_label_in_any_order_and_system(tmp_path):
    write_fcsv(tmp_path / "before.fcsv", LabelledPoints(("a", "b"), BEFORE_M), "LPS")
    write_fcsv(tmp_path / "after.fcsv", LabelledPoints(("b", "a"), AFTER_M[::-1]), "LPS")
    pairs = read_pair_of_lists(tmp_path / "before.fcsv", tmp_path / "after.fcsv", 1.0, "RAS", "markers")
    np.testing.assert_allclose(pairs.before, BEFORE_M * [-1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(pairs.after, AFTER_M * [-1, -1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected at least one row, got an empty file"),
        ("1,2,3\n", "expected the columns x, y, z, x_after, y_after, z_after, got 1, 2, 3"),
        ("x,y,z,x_after,y_after,z_after\n", "expected rows below the header"),
        ("1,2,3,7,8,9\n1,2,3,7,8\n", "line 2: expected 6 columns, got 5"),
        ("1,2,3,7,8,nan\n", "line 1: expected three finite coordinates, got '7, 8, nan'"),
        ("1,5,2,3,7,8,9\n1,2,3,7,8,9\n", "line 2: expected 7 columns, got 6"),
        ("1,2,3,7,8,9\n1,2,5,3,7,8,9\n", "line 2: expected 6 columns, got 7; numbers with decimal commas"),
        ("a,1,2,3,7,8,9\n#b,1,2,3,7,8,9\n", "line 2: expected a comment or a row"),
        ("a,1,2,3,7,8,9\na,1,2,4,7,8,9\n", "got a more than once"),
    ],
)
def test_tables_that_cannot_be_meant_are_refused(tmp_path, text, words):
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=words):
        read_table_of_pairs(path, 0.001, "LPS", "pairs")


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="expected a file, found none"):
        read_table_of_pairs(tmp_path / "none.csv", 0.001, "LPS", "pairs")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(InvalidInputError, match="expected text, got a file that is none"):
        read_table_of_pairs(tmp_path / "binary.csv", 0.001, "LPS", "pairs")


def test_labels_that_do_not_match_are_named(tmp_path):
    write_fcsv(tmp_path / "a.fcsv", LabelledPoints(("a", "b"), BEFORE_M), "LPS")
    write_fcsv(tmp_path / "b.fcsv", LabelledPoints(("a", "c"), AFTER_M), "LPS")
    with pytest.raises(InvalidInputError, match="markers a.fcsv and b.fcsv: .* got b, c in one of them only"):
        read_pair_of_lists(tmp_path / "a.fcsv", tmp_path / "b.fcsv", 1.0, "LPS", "markers")
