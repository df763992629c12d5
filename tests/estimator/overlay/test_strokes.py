"""Discs and contours, against the same written plainly."""

import numpy as np
import pytest

from softtissue_estimator.overlay.strokes import draw_contour, draw_disc


def plainly(cover, owner, row, column, radius, strength, label):
    """Cover a disc whose rows end at whole pixels, pixel by pixel."""
    for y in range(cover.shape[0]):
        for x in range(cover.shape[1]):
            below = radius * radius - (y - row) ** 2
            inside = abs(y - row) <= int(radius) and abs(x - column) <= int(np.sqrt(max(below, 0.0)))
            if inside and strength > float(cover[y, x]):
                cover[y, x] = strength
                owner[y, x] = label


def test_discs_are_those_drawn_plainly():
    """At the border, too, and over one another: of equal strengths in double precision the order counts."""
    rng = np.random.default_rng(0)
    covers, owners = np.zeros((2, 60, 70), np.float32), np.zeros((2, 60, 70), np.uint8)
    for label in range(1, 80):
        row, column = int(rng.integers(60)), int(rng.integers(70))
        # As single, 0.35 is smaller and 0.4 larger than what it stands for.
        radius, strength = rng.uniform(0.5, 15.0), float(rng.choice([0.35, 0.4, 0.5, rng.uniform()]))
        draw_disc(covers[0], owners[0], row, column, radius, strength, label)
        plainly(covers[1], owners[1], row, column, radius, strength, label)
    assert len(np.unique(owners[1])) > 20
    np.testing.assert_array_equal(covers[0], covers[1])
    np.testing.assert_array_equal(owners[0], owners[1])


@pytest.mark.parametrize("dashes", [0, 6])
def test_contour_of_a_part_is_that_of_the_whole(dashes):
    rows, columns = np.mgrid[:80, :90]
    whole = ((rows - 41) ** 2 + (columns - 52) ** 2 < 18**2).astype(np.float32)
    part = np.ascontiguousarray(whole[20:63, 31:75])
    assert part.sum() == whole.sum()
    drawn = []
    for nearness, corner in ((whole, (0, 0)), (part, (20, 31))):
        cover, owner = np.zeros(whole.shape, np.float32), np.zeros(whole.shape, np.uint8)
        draw_contour(nearness, *corner, 3, 0.8, dashes, 1.5, cover, owner)
        drawn.append((cover, owner))
    assert (drawn[0][1] == 3).sum() > 100
    np.testing.assert_array_equal(drawn[1][0], drawn[0][0])
    np.testing.assert_array_equal(drawn[1][1], drawn[0][1])
