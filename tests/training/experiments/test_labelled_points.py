"""Labelled points: pairs by label, and the other coordinate system."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.coordinates import convert_coordinates
from softtissue_training.experiments.labelled_points import LabelledPoints, match_labels


def test_same_labels_make_pairs():
    first = LabelledPoints(("a", "b"), np.array([[1.0, 0, 0], [2.0, 0, 0]]))
    second = LabelledPoints(("b", "a"), np.array([[20.0, 0, 0], [10.0, 0, 0]]))
    labels, before, after = match_labels(first, second)
    assert labels == ("a", "b")
    np.testing.assert_array_equal(after[:, 0], 10.0 * before[:, 0])
    with pytest.raises(
        InvalidInputError, match="markers: expected the same labels in both lists, got c in one"
    ):
        match_labels(first, LabelledPoints(("b", "a", "c"), np.zeros((3, 3))), "markers")
    with pytest.raises(InvalidInputError, match="every label once in the second list, got a more than once"):
        match_labels(first, LabelledPoints(("a", "a"), np.zeros((2, 3))))


def test_conversion_leaves_its_input_and_refuses_what_is_no_point():
    points = np.array([[1.0, 2.0, 3.0], [0.0, -1.0, -2.0]])
    converted = convert_coordinates(points, "RAS", "LPS")
    np.testing.assert_array_equal(converted, [[-1.0, -2.0, 3.0], [0.0, 1.0, -2.0]])
    np.testing.assert_array_equal(points[0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(convert_coordinates(points, "LPS", "LPS"), points)
    with pytest.raises(InvalidInputError, match="expected finite coordinates, got others at b"):
        LabelledPoints(("a", "b"), np.array([[0, 0, 0], [np.inf, 0, 0]]))
    with pytest.raises(InvalidInputError, match=r"expected shape \(1, 3\)"):
        LabelledPoints(("a",), np.zeros((2, 3)))
