"""The field of errors that neighbouring points share."""

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic.smooth_error import (
    LENGTH_M,
    MOST_CENTRES,
    SPACING_M,
    field_columns,
)

RNG = np.random.default_rng(0)
SEEN = np.column_stack([RNG.uniform(0.0, 0.08, size=(300, 2)), np.zeros(300)])


def covariance(first, second):
    squared = ((first[:, None] - second) ** 2).sum(axis=2)
    return np.exp(-squared / (2.0 * LENGTH_M**2))


def represented(seen):
    """Covariance (c, c) of each component at the places."""
    found = field_columns(torch.from_numpy(seen), seen).numpy()
    return found @ found.T


def test_covariance_at_the_seen_places_is_gaussian():
    error = np.abs(represented(SEEN) - covariance(SEEN, SEEN))
    # At the edges of what is seen no centres are beyond.
    assert error.max() < 0.2
    assert error.mean() < 0.01


def test_covariance_at_distant_places_is_gaussian_up_to_the_jitter():
    """They are all centres, and nothing is between them."""
    seen = 1.2 * SPACING_M * np.stack(np.meshgrid(range(4), range(4), [0]), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(represented(seen), covariance(seen, seen), atol=2e-6)


@pytest.mark.parametrize("length_m", [0.1, 0.2])
def test_centres_are_apart_and_near_what_is_seen(length_m):
    line = np.zeros((200, 3))
    line[:, 0] = np.linspace(0.0, length_m, len(line))
    count = field_columns(torch.from_numpy(line), line).shape[1]
    assert length_m / (2.0 * SPACING_M) <= count <= length_m / SPACING_M + 1.0


def test_much_that_is_seen_has_no_more_centres():
    much = RNG.uniform(0.0, 1.0, size=(2000, 3))
    assert field_columns(torch.from_numpy(much), much).shape == (2000, MOST_CENTRES)
    assert field_columns(torch.from_numpy(much[:1]), much[:1]).shape == (1, 1)
