"""The field of errors that neighbouring points share."""

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic.smooth_error import (
    LENGTH_M,
    MOST_CENTRES,
    SPACING_M,
    along_surface,
    field_columns,
    log_prior,
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


def test_slides_are_along_the_surface():
    """Of a dome, whose normals are up to 80 degrees off the ray."""
    angle, turn = RNG.uniform(0.0, 1.4, size=100), RNG.uniform(0.0, 2.0 * np.pi, size=100)
    normals = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    places = 0.05 * normals
    columns = field_columns(torch.from_numpy(places), places)
    ray = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    slide = along_surface(columns, ray, torch.from_numpy(normals)).numpy()
    np.testing.assert_allclose(np.einsum("sd,sdm->sm", normals, slide), 0.0, atol=1e-12)
    # At each place it is as likely along any tangent.
    for place, normal in enumerate(normals):
        size = (columns[place] ** 2).sum().item()
        found = slide[place] @ slide[place].T
        np.testing.assert_allclose(found, size * (np.eye(3) - np.outer(normal, normal)), atol=1e-12)


def test_slides_of_neighbours_are_alike():
    ray = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normals = np.array([[0.0, 0.6, 0.8], [0.01, 0.6, 0.8]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = along_surface(torch.ones((2, 1), dtype=torch.float64), ray, torch.from_numpy(normals)).numpy()
    np.testing.assert_allclose(found[0], found[1], atol=0.02)
    assert np.linalg.norm(found[0]) > 1.0


def test_large_errors_are_less_likely_beforehand():
    most = torch.tensor([4e-6, 1e-6], dtype=torch.float64)
    assert log_prior(torch.zeros(2, dtype=torch.float64), most) == 0.0
    # Each at its largest is four times its expectation.
    assert log_prior(most, most) == pytest.approx(-8.0)
    assert log_prior(0.25 * most, most) == pytest.approx(-4.0)
