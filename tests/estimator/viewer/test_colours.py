"""Colours of structures by their standard deviations."""

import numpy as np
import pytest

from estimator.viewer.moments import organ
from softtissue_estimator.viewer.colours import UNKNOWN, colours, sigma_colour


def lightness(colour):
    return float(np.dot(colour, [0.2126, 0.7152, 0.0722]))


def test_less_sure_is_darker_and_beyond_the_scale_nothing_changes():
    scale = [lightness(sigma_colour(sigma, 0.005)) for sigma in np.linspace(0.0, 0.005, 30)]
    assert (np.diff(scale) < 0.0).all()
    assert sigma_colour(0.005, 0.005) == sigma_colour(1.0, 0.005) == sigma_colour(np.inf, 0.005)


def test_scale_is_that_which_is_asked_for():
    assert sigma_colour(0.002, 0.004) == sigma_colour(0.004, 0.008) != sigma_colour(0.002, 0.008)


def test_unknown_deviation_has_a_colour_that_is_not_of_the_scale():
    assert sigma_colour(np.nan, 0.005) == UNKNOWN


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [(None, [(0, 0, 255), (255, 255, 0)]), (np.array([0.0, np.nan]), [(253, 231, 120), UNKNOWN])],
)
def test_structures_have_their_own_colours_or_those_of_their_deviations(sigma, expected):
    assert colours(organ(), sigma, 0.005) == expected
