"""Discs and contours, against the same written plainly."""

import numpy as np
import pytest

from softtissue_estimator.overlay.strokes import KEYS, draw_band, draw_contour, draw_disc, lay_bands


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


@pytest.mark.parametrize("shift", [0, 1])
def test_bands_cover_what_discs_do(shift):
    """In pixels twice as large: those whose middle is in a disc."""
    rng = np.random.default_rng(0)
    band = np.zeros(((61 >> shift) + 1, (71 >> shift) + 1), np.uint32)
    size, (rows, columns) = 1 << shift, np.indices(band.shape)
    expected, owners = np.zeros(band.shape), np.zeros(band.shape, int)
    for label in range(1, 60):
        row, column, radius = int(rng.integers(61)), int(rng.integers(71)), rng.uniform(0.5, 15.0)
        strength = label / 64.0
        draw_band(band, row, column, radius, np.uint32(KEYS * strength) << 8 | label, shift)
        middle = 0.5 * (size - 1)
        inside = (size * rows + middle - row) ** 2 + (size * columns + middle - column) ** 2 <= radius**2
        expected[inside], owners[inside] = strength, label
    cover, owner = rng.uniform(size=(61, 71)).astype(np.float32), np.zeros((61, 71), np.uint8)
    owner[::3] = 200
    before, whose = np.where(owner > 0, cover, 0.0), owner.copy()
    lay_bands(band, shift, cover, owner)
    fine, of = (table.repeat(size, 0).repeat(size, 1)[:61, :71] for table in (expected, owners))
    np.testing.assert_allclose(np.where(owner > 0, cover, 0.0), np.maximum(before, fine), atol=1e-6)
    np.testing.assert_array_equal(owner, np.where(fine > before, of, whose))
