"""Sets of loads that may act, against all sets that there are."""

from itertools import product

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic import load_sets
from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.load_sets import draw_load_sets
from softtissue_estimator.estimators.elastic.relevance import determine_relevance

LOADS, FIELD, NUISANCE, ROWS = 3, 2, 1, 14
LEVELS, EQUAL = np.array([1.0, 16.0]), 0.04
RNG = np.random.default_rng(8)
# Loads that look alike: it is open which of them acts. The nuisance parameter looks like a bit of all.
ALIKE = RNG.normal(size=(ROWS, 3))
MODEL = np.concatenate(
    [0.3 * RNG.normal(size=(ROWS, FIELD))]
    + [ALIKE + 0.3 * RNG.normal(size=(ROWS, 3)) for _ in range(LOADS)]
    + [ALIKE.sum(axis=1)[:, None]],
    axis=1,
)
TRUTH = np.concatenate([np.zeros(FIELD), [0.5, -0.4, 0.2], np.zeros(6), [0.6]])
DATA = MODEL @ TRUTH + RNG.normal(size=ROWS)
START = Variances(torch.full((LOADS,), EQUAL, dtype=torch.float64), torch.tensor([0.09], dtype=torch.float64))

NEAR = torch.full((LOADS,), 1e-9)  # loads that move nothing far


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(load_sets, "LEVELS", LEVELS)
    monkeypatch.setattr(load_sets, "EXPECTED_LOADS", 1.0)


def amplitudes(data=DATA, updates=1):
    gram, right = torch.from_numpy(MODEL.T @ MODEL), torch.from_numpy(MODEL.T @ data)
    return determine_relevance(gram, right, START, (FIELD,), updates, 1e-6)


def drawn(found, seed=0):
    return draw_load_sets(found, torch.full((LOADS,), EQUAL, dtype=torch.float64), NEAR, LOADS, seed)


def enumerated(found):
    """Mean and covariance of all amplitudes, over every set of loads with every variance, by its probability."""
    field = float(found.prior.fields)
    weights, means, covariances = [], [], []
    for levels in product((0.0, *LEVELS), repeat=LOADS):
        prior = (1.0 / LOADS / len(LEVELS)) ** sum(level > 0.0 for level in levels)
        variances = np.concatenate(
            [np.full(FIELD, field), np.repeat(EQUAL * np.array(levels), 3), np.ones(NUISANCE)]
        )
        seen = (MODEL * variances) @ MODEL.T + np.eye(ROWS)
        gain = variances[:, None] * MODEL.T @ np.linalg.inv(seen)
        evidence = -0.5 * (DATA @ np.linalg.solve(seen, DATA) + np.linalg.slogdet(seen)[1])
        weights.append(np.log(prior) + evidence)
        means.append(gain @ DATA)
        covariances.append(np.diag(variances) - gain @ MODEL * variances)
    weight = np.exp(np.array(weights) - max(weights))
    weight /= weight.sum()
    mean = np.einsum("s,sr->r", weight, means)
    away = np.array(means) - mean
    return mean, np.einsum("s,srq->rq", weight, covariances) + np.einsum("s,sr,sq->rq", weight, away, away)


def test_draws_are_those_of_all_sets_by_their_probability(small, monkeypatch):
    monkeypatch.setattr(load_sets, "SWEEPS", 6000)
    found = amplitudes()
    sets, (mean, covariance) = drawn(found), enumerated(found)
    assert {len(each.loads) for each in sets.drawn} == {0, 1, 2, 3}
    spread = np.sqrt(np.diag(covariance))
    assert np.abs((np.mean([each.mean for each in sets.drawn], axis=0) - mean) / spread).max() < 0.06
    # About the answer, which is that of the relevant loads.
    away = found.mean.numpy() - mean
    covariance = covariance + away[:, None] * away
    assert sets.nuisance_covariance == pytest.approx(covariance[-1:, -1:], rel=0.06)
    response = RNG.normal(size=(4, 3, 3 * LOADS))
    loads = slice(FIELD, FIELD + 3 * LOADS)
    exact = response @ covariance[loads, loads] @ response.transpose(0, 2, 1)
    scale = np.abs(exact).max()
    assert sets.covariance(response) == pytest.approx(exact, abs=0.06 * scale)
    moving = RNG.normal(size=(4, 3, NUISANCE))
    both = np.concatenate([response, moving], axis=2)
    exact = both @ covariance[FIELD:, FIELD:] @ both.transpose(0, 2, 1)
    assert sets.covariance(response, moving) == pytest.approx(exact, abs=0.06 * np.abs(exact).max())


def test_likeliest_variances_are_surer_than_all_sets(small, monkeypatch):
    monkeypatch.setattr(load_sets, "SWEEPS", 400)
    # The observation that the nuisance parameter explains alone leaves no load relevant.
    data = MODEL[:, -1] * 0.8
    found = amplitudes(data, updates=60)
    sets, begin = drawn(found), FIELD + 3 * LOADS
    relevant = np.linalg.inv(found.factor.numpy()[begin:, begin:])
    assert float(found.variances.max()) < 1e-3 * EQUAL
    assert sets.nuisance_covariance[0, 0] > 1.3 * float(np.square(relevant).sum())


def test_same_seed_draws_the_same_sets(small):
    found = amplitudes()
    first, again, other = drawn(found), drawn(found), drawn(found, seed=1)
    assert len(first.drawn) == load_sets.SWEEPS - 20
    means = [[each.mean for each in one.drawn] for one in (first, again, other)]
    assert np.array_equal(means[0], means[1]) and not np.array_equal(means[0], means[2])


def test_no_load_moves_anything_farther_than_a_load_can(small):
    # Of which nothing is seen: what is known of it afterwards is what was known before.
    unseen = MODEL.copy()
    unseen[:, FIELD + 6 : FIELD + 9] = 0.0
    gram, right = torch.from_numpy(unseen.T @ unseen), torch.from_numpy(unseen.T @ DATA)
    found = determine_relevance(gram, right, START, (FIELD,), 1, 1e-6)
    response = np.zeros((1, 3, 3 * LOADS))
    response[0, :, 6:9] = 2.0 * np.eye(3)
    equal, powers = torch.full((LOADS,), EQUAL, dtype=torch.float64), torch.tensor([1e-9, 1e-9, 3.0 * 2.0**2])
    far, near = (
        draw_load_sets(found, equal, farthest, LOADS).covariance(response) for farthest in (NEAR, powers)
    )
    assert np.sqrt(near.diagonal(axis1=1, axis2=2)).max() < load_sets.FARTHEST_M
    assert np.sqrt(far.diagonal(axis1=1, axis2=2)).min() > 5.0 * load_sets.FARTHEST_M


def test_loads_behind_the_pushing_ones_never_act(small):
    found = amplitudes()
    sets = draw_load_sets(found, torch.full((LOADS,), EQUAL, dtype=torch.float64), NEAR, 1)
    assert {load for each in sets.drawn for load in each.loads} <= {0}
    assert not any(each.mean[FIELD + 3 : FIELD + 3 * LOADS].any() for each in sets.drawn)
