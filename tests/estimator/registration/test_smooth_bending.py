"""Evidence of an organ that may bend, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from estimator.lump import make_lump
from softtissue_estimator.registration import smooth_bending
from softtissue_estimator.registration.pose_score import Fit
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.smooth_bending import BENDING_M, LENGTH_M, SmoothBending

SIGMA_M = smooth_bending._SIGMA_M
SURE = 30.0  # logarithm of how much likelier a point is on the organ: all are


@pytest.fixture(scope="module")
def surface() -> PoseSurface:
    return PoseSurface(make_lump())


@pytest.fixture(scope="module")
def bending(surface) -> SmoothBending:
    return SmoothBending(surface)


def fit(height, sample, alike=SURE) -> Fit:
    height = np.atleast_2d(height)
    nothing, vectors = np.zeros_like(height), np.zeros((*height.shape, 3))
    return Fit(
        vectors,
        vectors,
        np.broadcast_to(sample, height.shape),
        height,
        nothing,
        np.full_like(height, alike),
        nothing,
        np.ones_like(height),
    )


def test_modes_have_the_covariance_of_the_field(surface, bending):
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, len(surface.points), (2, 500))
    apart = np.linalg.norm(surface.points[one] - surface.points[other], axis=1)
    alike = (surface.normals[one] * surface.normals[other]).sum(axis=1)
    expected = BENDING_M**2 * np.exp(-0.5 * (apart / LENGTH_M) ** 2) * alike
    found = (bending.modes[one] * bending.modes[other]).sum(axis=1)
    assert np.abs(found - expected).max() < 0.1 * BENDING_M**2
    assert (bending.modes**2).sum(axis=1).mean() == pytest.approx(BENDING_M**2, rel=0.02)


def test_gain_is_the_evidence_of_a_gaussian_process(bending):
    rng = np.random.default_rng(1)
    sample = np.arange(0, 400, 5)
    modes = bending.modes[sample]
    height = modes @ rng.normal(size=modes.shape[1]) + rng.normal(0.0, SIGMA_M, len(sample))
    covariance = modes @ modes.T + SIGMA_M**2 * np.eye(len(sample))
    expected = SURE * len(sample) + multivariate_normal(np.zeros(len(sample)), covariance).logpdf(height)
    assert bending.gain(fit(height, sample))[0] == pytest.approx(expected, abs=1e-6)


def test_what_is_not_smooth_costs_more(bending):
    rng = np.random.default_rng(2)
    sample = np.arange(0, 1600, 8)
    smooth = bending.modes[sample] @ rng.normal(size=bending.modes.shape[1])
    gain = bending.gain(fit(np.stack([np.zeros_like(smooth), smooth, rng.permutation(smooth)]), sample))
    assert gain[0] > gain[1] > gain[2] + 10.0


def test_points_that_are_not_organ_change_nothing(bending):
    sample = np.arange(0, 1600, 8)
    alone = fit(np.full(len(sample), 0.001), sample)
    height = np.concatenate([alone.height[0], np.full(100, 0.03)])
    both = fit(height, np.concatenate([sample, np.arange(100)]))
    away = np.arange(len(height)) >= len(sample)
    both = replace(both, weight=np.where(away, 1e-9, 1.0)[None])
    assert bending.gain(both)[0] == pytest.approx(bending.gain(alone)[0], abs=1e-9)
    # Where a point might be organ by its place at first, but not by the field, it is let go.
    tried = replace(both, alike=np.where(away, 0.0, SURE)[None], weight=np.where(away, 0.01, 1.0)[None])
    assert bending.gain(tried)[0] == pytest.approx(bending.gain(alone)[0], abs=1.0)
