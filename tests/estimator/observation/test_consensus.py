"""Which points hang together."""

import numpy as np
import pytest

from estimator.shapes import rotation
from softtissue_estimator.observation.consensus import continuous

RNG = np.random.default_rng(4)


def surface(count=1200, noise=0.0005):
    """A bent sheet, half a turn of a cylinder's surface, that bends further and turns by 60 degrees."""
    u, v = RNG.uniform(-0.06, 0.06, size=(2, count))
    places = np.column_stack([u, v, 4.0 * u**2])
    turn = rotation([1.0, 2.0, -1.0], np.pi / 3.0)
    moved = places @ turn.T + np.column_stack([0.0 * u, 0.0 * u, 3.0 * (u + 0.06) ** 2]) - places
    return places, moved + noise * RNG.normal(size=moved.shape)


def test_continuous_motion_is_kept_whole():
    assert continuous(*surface()).all()
    assert continuous(*surface(noise=0.002)).mean() > 0.99


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_points_put_anywhere_are_found(share):
    places, moved = surface()
    wrong = RNG.random(len(places)) < share
    moved[wrong] += 0.03 * RNG.normal(size=(wrong.sum(), 3))
    kept = continuous(places, moved)
    assert kept[~wrong].mean() > 0.98
    assert kept[wrong].mean() < 0.05


@pytest.mark.parametrize(
    ("offset", "count"), [(0.010, 1200), (0.017, 1200), (0.1, 1200), (0.017, 6000), (0.1, 6000)]
)
def test_piece_that_moves_otherwise_is_found(offset, count):
    places, moved = surface(count)
    distance = np.linalg.norm(places - places[7], axis=1)
    piece = distance < np.quantile(distance, 0.3)
    moved[piece] += offset * np.array([0.6, 0.0, 0.8])
    kept = continuous(places, moved)
    assert kept[~piece].mean() > 0.995
    assert kept[piece].mean() < 0.05


def test_part_beside_which_nothing_is_seen_cannot_be_judged():
    places, moved = surface()
    apart = places[:, 0] > 0.03
    seen = apart | (places[:, 0] < 0.01)
    moved[apart] += [0.0, 0.02, 0.0]
    assert continuous(places[seen], moved[seen]).all()


def test_few_points_are_kept():
    places, moved = surface(8)
    assert continuous(places, 10.0 * moved).all()


def test_of_many_points_all_are_judged():
    places, moved = surface(9000)
    wrong = RNG.random(len(places)) < 0.2
    moved[wrong] += 0.03 * RNG.normal(size=(wrong.sum(), 3))
    kept = continuous(places, moved)
    assert kept[~wrong].mean() > 0.98
    assert kept[wrong].mean() < 0.05
