"""The largest standard deviation of each structure."""

import numpy as np
import pytest

from softtissue_estimator.estimators.structure_sigma import largest_sigmas, uncertain_structures
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_organ


@pytest.fixture(scope="module")
def organ():
    return load_organ(bundled_organ())


def test_each_structure_has_its_own_largest(organ):
    sigma = np.random.default_rng(0).uniform(size=len(organ.query_points))
    sigma[len(organ.structure_points) :] += 10.0  # the surface is no structure
    inside = sigma[: len(organ.structure_points)]
    expected = [inside[organ.structure_index == number].max() for number in range(len(organ.structures))]
    np.testing.assert_array_equal(largest_sigmas(organ, sigma), expected)


def test_without_standard_deviations_none_is_too_large(organ):
    largest = largest_sigmas(organ, None)
    assert len(largest) == len(organ.structures) and np.isnan(largest).all()
    assert uncertain_structures(organ, largest, 0.001) is None


def test_the_worst_is_named(organ):
    largest = np.full(len(organ.structures), 0.004)
    assert uncertain_structures(organ, largest, 0.004) is None
    largest[1] = 0.006
    said = uncertain_structures(organ, largest, 0.005)
    assert repr(organ.structures[1].name) in said and "at most 5 mm" in said and "got 6 mm" in said
