"""Which Poisson's ratios are considered."""

import numpy as np
import pytest

from softtissue_estimator.estimators.elastic.tissue import ratio_prior


def test_what_is_known_is_not_asked():
    prior = ratio_prior(0.37, 0.0)
    assert prior.ratios == (0.37,)
    assert prior.expected == 0


def test_values_reach_two_standard_deviations_as_far_as_tissue_does():
    prior = ratio_prior(0.35, 0.1)
    assert prior.ratios == pytest.approx((0.25, 0.30, 0.35, 0.40, 0.45, 0.48))
    assert prior.ratios[prior.expected] == 0.35
    assert ratio_prior(0.40, 0.025).ratios == pytest.approx((0.35, 0.40, 0.45))


def test_the_expected_one_is_kept_wherever_it_is():
    prior = ratio_prior(0.49, 0.05)
    assert prior.ratios == pytest.approx((0.39, 0.44, 0.48, 0.49))
    assert prior.ratios[prior.expected] == 0.49


def test_probabilities_are_those_of_a_normal_distribution():
    prior = ratio_prior(0.35, 0.1)
    expected = -0.5 * ((np.array(prior.ratios) - 0.35) / 0.1) ** 2
    np.testing.assert_allclose(prior.log_probability, expected, atol=1e-12)
