"""Evidence of an organ that may bend, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from estimator.lump import make_lump, part_of
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration import smooth_bending
from softtissue_estimator.registration.oriented_cloud import OrientedCloud
from softtissue_estimator.registration.pose_score import Fit, PoseScore
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import Poses
from softtissue_estimator.registration.smooth_bending import (
    BENDING_M,
    ELASTIC_M,
    LENGTH_M,
    PoseEvidence,
    SmoothBending,
)

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
    assert bending.explained(fit(height, sample))[0][0] == pytest.approx(expected, abs=1e-6)


def test_what_is_not_smooth_costs_more(bending):
    rng = np.random.default_rng(2)
    sample = np.arange(0, 1600, 8)
    smooth = bending.modes[sample] @ rng.normal(size=bending.modes.shape[1])
    tried = np.stack([np.zeros_like(smooth), smooth, rng.permutation(smooth)])
    gain, _ = bending.explained(fit(tried, sample))
    assert gain[0] > gain[1] > gain[2] + 10.0


def test_points_that_are_not_organ_change_nothing(bending):
    sample = np.arange(0, 1600, 8)
    alone = fit(np.full(len(sample), 0.001), sample)
    height = np.concatenate([alone.height[0], np.full(100, 0.03)])
    both = fit(height, np.concatenate([sample, np.arange(100)]))
    away = np.arange(len(height)) >= len(sample)
    both = replace(both, weight=np.where(away, 1e-9, 1.0)[None])
    assert bending.explained(both)[0][0] == pytest.approx(bending.explained(alone)[0][0], abs=1e-9)
    # Where a point might be organ by its place at first, but not by the field, it is let go.
    tried = replace(both, alike=np.where(away, 0.0, SURE)[None], weight=np.where(away, 0.01, 1.0)[None])
    assert bending.explained(tried)[0][0] == pytest.approx(bending.explained(alone)[0][0], abs=1.0)


def test_covariance_is_of_elastic_modes_and_a_weaker_smooth_field(surface, bending):
    places = surface.points / 0.05
    elastic = np.column_stack([np.sin(places), np.cos(2.0 * places)]).astype(np.float32)
    elastic /= np.sqrt((elastic**2).sum(axis=1).mean())
    both = SmoothBending(surface, elastic).modes
    assert both.shape == bending.modes.shape
    found, smooth = both[::20] @ both[::20].T, bending.modes[::20] @ bending.modes[::20].T
    expected = ELASTIC_M**2 * elastic[::20] @ elastic[::20].T + 0.25 * smooth
    assert np.abs(found - expected).max() < 0.05 * ELASTIC_M**2


def test_bent_surface_is_that_of_the_cloud(surface, bending):
    rng = np.random.default_rng(4)
    sample = np.arange(0, 1600, 2)
    field = bending.modes @ rng.normal(size=bending.modes.shape[1])
    _, bent = bending.explained(fit(np.stack([0.0 * field[sample], field[sample]]), sample))
    np.testing.assert_allclose(bent[0], 0.0, atol=1e-9)
    assert np.sqrt(np.mean((bent[1] - field) ** 2)) < 0.2 * np.sqrt(np.mean(field**2))


def test_what_a_bent_organ_does_not_hide_costs_nothing(surface):
    """A plate behind the lump, whose top is dented by as much as it stood out before the plate."""
    x, y = np.meshgrid(np.linspace(-0.15, 0.15, 90), np.linspace(-0.15, 0.15, 90))
    camera = np.array([0.0, 0.0, 0.5])
    plate = OrientedCloud(np.stack([x, y, np.full_like(x, 0.005)], axis=-1).reshape(-1, 3), camera)
    score, pose = PoseScore(surface, plate), Poses.of([RigidMotion(np.eye(3), np.zeros(3))])
    top = surface.points[:, 2] > 0.0
    # Down along the normal as far as it is high, over the slope.
    dent = np.where(top, -surface.points[:, 2] / np.maximum(surface.normals[:, 2], 0.2), 0.0)
    rigid, outwards = score.cost(pose), score.cost(pose, bent=np.abs(dent)[None])
    assert rigid[0] > 100.0 and outwards[0] >= rigid[0]
    assert score.cost(pose, bent=dent[None])[0] < 0.1 * rigid[0]
    assert score.cost(pose, bent=np.zeros((1, len(dent))))[0] == rigid[0]


@pytest.mark.parametrize("step", [[0.003, -0.002, 0.002, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.03, -0.04, 0.03]])
def test_refined_pose_is_where_the_organ_need_not_bend(surface, bending, step):
    pose = RigidMotion(np.eye(3), np.array([0.0, 0.0, -0.3]))
    score = PoseScore(surface, OrientedCloud(pose.apply(part_of(make_lump())), np.zeros(3)))
    beside = Poses.of([pose]).moved(np.array([step]), surface.centre)
    refined = PoseEvidence([score], bending).refined(beside)
    assert len(refined) == 2
    np.testing.assert_array_equal(refined.rotation[0], beside.rotation[0])
    left = np.linalg.norm(refined.apply(surface.points) - pose.apply(surface.points), axis=2).mean(axis=1)
    assert left[1] < 0.4 * left[0]
