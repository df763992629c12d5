"""Automatic relevance determination against the evidence that it maximises."""

import dataclasses

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.relevance import PRUNED_SHARE, determine_relevance

GROUPS, FIELD, NUISANCE, ROWS, NOISE = 20, 15, 2, 120, 0.05
LOADS = 3 * GROUPS
LEAST_FIELD = 1e-6
RNG = np.random.default_rng(4)
MODEL = RNG.normal(size=(ROWS, LOADS + FIELD + NUISANCE))
TRUTH = np.zeros(MODEL.shape[1])
TRUTH[FIELD + 3 * 7 : FIELD + 3 * 8] = [1.0, -2.0, 0.5]
TRUTH[FIELD + 3 * 12 : FIELD + 3 * 13] = [0.0, 1.0, 1.5]
TRUTH[FIELD + LOADS :] = [0.5, -1.5]
FIELD_SIGMA = 0.2
ERRORS = FIELD_SIGMA * RNG.normal(size=FIELD)
DATA = MODEL @ TRUTH + NOISE * RNG.normal(size=ROWS)
WITH_ERRORS = DATA + MODEL[:, :FIELD] @ ERRORS
GRAM = torch.from_numpy(MODEL.T @ MODEL / NOISE**2)
START = Variances(torch.ones(GROUPS, dtype=torch.float64), torch.tensor([0.05], dtype=torch.float64))
GIVEN = Variances(torch.linspace(0.1, 2.0, GROUPS, dtype=torch.float64), START.fields)


def right(data):
    return torch.from_numpy(MODEL.T @ data / NOISE**2)


def determined(updates, data=DATA, start=START):
    return determine_relevance(GRAM, right(data), start, (FIELD,), updates, LEAST_FIELD)


def by_parameter(variances):
    """Prior variance of every parameter."""
    return np.concatenate(
        [
            np.full(FIELD, float(variances.fields)),
            np.repeat(variances.loads.numpy(), 3),
            np.ones(NUISANCE),
        ]
    )


def log_evidence(variances, data):
    """log N(y; 0, J V J^T + sigma^2 I), without its constant."""
    covariance = (MODEL * by_parameter(variances)) @ MODEL.T + NOISE**2 * np.eye(ROWS)
    return -0.5 * (data @ np.linalg.solve(covariance, data) + np.linalg.slogdet(covariance)[1])


def covariance_of(amplitudes, prior):
    """Posterior covariance of every parameter from its factor and prior variances."""
    inverse = np.linalg.inv(amplitudes.factor.numpy() @ amplitudes.factor.numpy().T)
    root = np.sqrt(prior)
    return root[:, None] * inverse * root


def test_posterior_of_given_variances_is_the_closed_form():
    found = determined(0, start=GIVEN)
    covariance = np.linalg.inv(GRAM.numpy() + np.diag(1.0 / by_parameter(GIVEN)))
    mean = covariance @ right(DATA).numpy()
    np.testing.assert_allclose(found.mean.numpy(), mean, atol=1e-10)
    np.testing.assert_allclose(covariance_of(found, by_parameter(GIVEN)), covariance, atol=1e-12)
    np.testing.assert_allclose(found.root.numpy() ** 2, by_parameter(GIVEN)[FIELD:-NUISANCE])
    np.testing.assert_array_equal(found.field.numpy(), found.mean[:FIELD].numpy())
    np.testing.assert_array_equal(found.loads.numpy(), found.mean[FIELD:-NUISANCE].numpy())
    np.testing.assert_array_equal(found.nuisance.numpy(), found.mean[-NUISANCE:].numpy())


def test_factor_of_the_loads_leaves_their_doubt_and_that_of_the_nuisance():
    found = determined(0, start=GIVEN)
    inverse = np.linalg.inv(found.loads_factor.numpy())
    root = np.sqrt(by_parameter(GIVEN)[FIELD:])
    expected = covariance_of(found, by_parameter(GIVEN))[FIELD:, FIELD:]
    np.testing.assert_allclose(root[:, None] * (inverse.T @ inverse) * root, expected, atol=1e-12)


def test_evidence_compares_as_that_of_the_dense_model():
    starts = START, GIVEN, dataclasses.replace(START, fields=20.0 * START.fields)
    power = float(DATA @ DATA) / NOISE**2
    found = [determined(0, start=start).log_evidence(power) for start in starts]
    expected = [log_evidence(start, DATA) for start in starts]
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-8)


@pytest.mark.parametrize("data", [DATA, WITH_ERRORS], ids=["loads", "loads and errors"])
def test_every_update_raises_the_evidence(data):
    evidence = [log_evidence(determined(updates, data).prior, data) for updates in range(8)]
    # Near its maximum an update may go past it by next to nothing.
    assert (np.diff(evidence) > -1e-3).all()
    assert (np.diff(evidence)[:3] > 0.0).all()


def test_only_the_loads_that_act_stay_relevant():
    found = determined(30)
    assert set(np.flatnonzero(found.variances.numpy() > 0.01)) == {7, 12}
    np.testing.assert_allclose(found.mean.numpy(), TRUTH, atol=0.05)


def test_the_field_has_the_size_of_the_errors_and_none_where_there_are_none():
    size = np.sqrt(np.mean(ERRORS**2))
    for start in (0.05, 1e-4):
        begin = dataclasses.replace(START, fields=torch.tensor([start], dtype=torch.float64))
        found = determined(30, WITH_ERRORS, begin)
        assert float(found.prior.fields.sqrt()) == pytest.approx(size, rel=0.1)
        np.testing.assert_allclose(found.field.numpy(), ERRORS, atol=0.05)
        assert set(np.flatnonzero(found.variances.numpy() > 0.01)) == {7, 12}
    exact = determined(30, MODEL @ TRUTH)
    assert float(exact.prior.fields) == pytest.approx(LEAST_FIELD, rel=1e-9)


def test_two_fields_have_each_the_size_of_their_errors():
    """Half of the values are errors, and the other half are none."""
    half = FIELD // 2
    errors = np.r_[ERRORS[:half], np.zeros(FIELD - half)]
    start = dataclasses.replace(START, fields=torch.tensor([0.05, 0.05], dtype=torch.float64))
    data = DATA + MODEL[:, :FIELD] @ errors
    found = determine_relevance(GRAM, right(data), start, (half, FIELD - half), 30, LEAST_FIELD)
    size = np.sqrt(np.mean(errors[:half] ** 2))
    assert float(found.prior.fields[0].sqrt()) == pytest.approx(size, rel=0.15)
    assert float(found.prior.fields[1]) < 0.1 * float(found.prior.fields[0])
    np.testing.assert_allclose(found.field.numpy(), errors, atol=0.05)
    most = found.prior.fields.new_tensor([1e-3, 1.0])
    bounded = determine_relevance(GRAM, right(data), start, (half, FIELD - half), 30, LEAST_FIELD, most)
    assert float(bounded.prior.fields[0]) == 1e-3


def test_pruned_loads_keep_their_variances_and_the_others_go_on_without_them():
    first = determined(4)
    kept = first.variances > PRUNED_SHARE * first.variances.max()
    assert 2 <= int(kept.sum()) < GROUPS
    second = determined(5).prior
    assert torch.equal(second.loads[~kept], first.variances[~kept])
    used = np.concatenate([np.ones(FIELD, bool), np.repeat(kept.numpy(), 3), np.ones(NUISANCE, bool)])
    alone = determine_relevance(
        GRAM[used][:, used],
        right(DATA)[used],
        Variances(first.variances[kept], first.prior.fields),
        (FIELD,),
        1,
        LEAST_FIELD,
    )
    np.testing.assert_allclose(second.loads[kept].numpy(), alone.variances.numpy(), rtol=1e-10)
    assert float(second.fields) == pytest.approx(float(alone.prior.fields), rel=1e-10)


def in_single_updates(updates, data, start, least_field):
    """The same, each update with the whole field and all loads."""
    prior = start
    for _ in range(updates):
        prior = determine_relevance(GRAM, right(data), prior, (FIELD,), 1, least_field).prior
    return prior


def test_a_field_at_its_least_is_integrated_out_and_not_left_out():
    least = (2.0 * FIELD_SIGMA) ** 2
    start = dataclasses.replace(START, fields=torch.tensor([least], dtype=torch.float64))
    found = determine_relevance(GRAM, right(WITH_ERRORS), start, (FIELD,), 6, least)
    expected = in_single_updates(6, WITH_ERRORS, start, least)
    assert float(found.prior.fields) == float(expected.fields) == least
    # The others are pruned on the way.
    assert set(np.flatnonzero(found.variances.numpy() > 0.01)) == {7, 12}
    np.testing.assert_allclose(found.variances[[7, 12]].numpy(), expected.loads[[7, 12]].numpy(), rtol=1e-3)
    np.testing.assert_allclose(found.field.numpy(), ERRORS, atol=0.05)
    without = Variances(start.loads, start.fields[:0])
    left_out = determine_relevance(GRAM[FIELD:, FIELD:], right(WITH_ERRORS)[FIELD:], without, (), 6, least)
    assert not np.allclose(left_out.variances[[7, 12]].numpy(), expected.loads[[7, 12]].numpy(), rtol=1e-3)


def test_a_field_that_grows_from_its_least_is_told_in_every_update():
    start = dataclasses.replace(START, fields=torch.tensor([LEAST_FIELD], dtype=torch.float64))
    expected = in_single_updates(6, WITH_ERRORS, start, LEAST_FIELD)
    found = determined(6, WITH_ERRORS, start).prior
    assert float(found.fields) == pytest.approx(float(expected.fields), rel=0.02)
    assert float(found.fields) > 1e3 * LEAST_FIELD


def test_what_is_held_stays_held():
    held = dataclasses.replace(START, loads=START.loads.clone())
    held.loads[7] *= 1e-9
    found = determined(5, start=held)
    assert torch.equal(found.variances[7], held.loads[7])
    assert np.abs(found.loads[21:24].numpy()).max() < 1e-4


def test_without_a_signal_nothing_is_relevant_and_nothing_fails():
    # Until the variances have fallen below the smallest number that there is.
    for updates in (40, 80):
        found = determined(updates, np.zeros(ROWS))
        assert float(found.variances.max()) < 1e-3
        assert float(found.prior.fields) == LEAST_FIELD
        np.testing.assert_array_equal(found.mean.numpy(), 0.0)


def test_some_of_the_loads_alone_leave_the_doubt_of_the_closed_form():
    whole = determined(0, start=GIVEN)
    kept = torch.tensor([2, 7, 12])
    found = whole.with_loads(kept)
    used = np.concatenate(
        [
            np.arange(FIELD),
            (FIELD + 3 * kept[:, None] + torch.arange(3)).reshape(-1).numpy(),
            np.arange(FIELD + LOADS, len(TRUTH)),
        ]
    )
    prior = by_parameter(GIVEN)[used]
    expected = np.linalg.inv(GRAM.numpy()[np.ix_(used, used)] + np.diag(1.0 / prior))
    np.testing.assert_allclose(covariance_of(found, prior), expected, atol=1e-12)
    np.testing.assert_array_equal(found.mean.numpy(), whole.mean.numpy()[used])
    assert torch.equal(found.variances, GIVEN.loads[kept])
    assert torch.equal(found.nuisance, whole.nuisance)
