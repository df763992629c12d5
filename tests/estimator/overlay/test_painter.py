"""What the overlay draws: which pixels, how strongly, how wide; checked against spheres, whose outlines are known."""

import numpy as np
import pytest

from estimator.overlay.ball import balls
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.overlay import painter
from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import make_camera
from softtissue_estimator.overlay.labels import Label, banner_rows, write_banner, write_labels
from softtissue_estimator.overlay.painter import outline, paint
from softtissue_estimator.overlay.scene import Placed
from softtissue_estimator.view.structures import make_structures

FOCAL = 600.0
CAMERA = make_camera((640, 480), [FOCAL, 0.0, 319.5, 0.0, FOCAL, 239.5, 0.0, 0.0, 1.0])
GREY = 90


def picture():
    return np.full((480, 640, 3), GREY, np.uint8)


def changed(image):
    return (image != GREY).any(axis=2)


def radius_px(radius, depth):
    """Of the circle as which a sphere on the optical axis is seen."""
    return FOCAL * radius / np.sqrt(depth**2 - radius**2)


def reach(mask):
    """Half the extent of a mask along the middle row, pixels."""
    columns = np.flatnonzero(mask[240])
    return 0.5 * (columns[-1] - columns[0])


def test_outline_is_that_of_the_sphere():
    image = picture()
    structures, placed = balls([(0.0, 0.0, 0.15)], [0.02])
    (shown,) = paint(image, CAMERA, structures, placed, names=False)
    wanted = radius_px(0.02, 0.15)
    assert shown.pixels == pytest.approx(np.pi * wanted**2, rel=0.01)
    line = reach(changed(image))
    assert wanted < line < wanted + 2.0
    np.testing.assert_array_equal(image[:10], GREY)


@pytest.mark.parametrize("times", [1, 2])
def test_what_is_spared_stays_as_it_is_and_the_rest_is_drawn(times):
    """Also where nothing has changed since the image before."""
    structures, placed = balls([(0.0, 0.0, 0.15)], [0.02])
    rng = np.random.default_rng(5)
    before = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    spared = np.zeros((480, 640), np.uint8)
    spared[:, 300:350] = 255
    painter_ = painter.Painter(Buffers())
    for _ in range(times):
        image, whole = before.copy(), before.copy()
        painter_.paint(image, CAMERA, structures, placed, names=False, spared=spared)
    paint(whole, CAMERA, structures, placed, names=False)
    assert (whole != before)[:, 300:350].any()
    np.testing.assert_array_equal(image, np.where(spared[..., None] > 0, before, whole))


def test_names_cover_nothing_that_is_spared():
    structures, placed = balls([(0.0, 0.0, 0.15)], [0.02])
    plain, kept = picture(), picture()
    paint(plain, CAMERA, structures, placed)
    unnamed = picture()
    paint(unnamed, CAMERA, structures, placed, names=False)
    name = (plain != unnamed).any(axis=2)
    assert name.any()
    spared = np.where(name, np.uint8(255), np.uint8(0))
    (shown,) = paint(kept, CAMERA, structures, placed, spared=spared)
    np.testing.assert_array_equal(kept[name], GREY)
    moved = (kept != unnamed).any(axis=2)
    assert shown.pixels and moved.any() and not (moved & name).any()


def test_sigma_is_half_the_width_of_the_band():
    thin, wide = picture(), picture()
    for image, sigma in ((thin, 0.0), (wide, 0.003)):
        paint(image, CAMERA, *balls([(0.0, 0.0, 0.15)], [0.02], sigma=sigma), names=False)
    assert (
        reach(changed(wide)) == pytest.approx(radius_px(0.02, 0.15) + FOCAL * 0.003 / 0.15, abs=1.5)
        and reach(changed(thin)) < radius_px(0.02, 0.15) + 2.0
    )


def test_margin_is_drawn_round_tumours_alone():
    centres, radii = [(-0.04, 0.0, 0.2), (0.04, 0.0, 0.2)], [0.008, 0.008]
    image = picture()
    paint(image, CAMERA, *balls(centres, radii, kinds=["vessel", "tumour"]), margin_m=0.010, names=False)
    mask = changed(image)
    assert mask[:, :320].any(axis=0).sum() == pytest.approx(2.0 * radius_px(0.008, 0.2), abs=4.0)
    assert mask[:, 320:].any(axis=0).sum() == pytest.approx(2.0 * radius_px(0.018, 0.2), abs=4.0)


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_nearer_structure_covers_the_one_behind_it_in_its_own_colour(order):
    """A blue ball in front of a yellow one that is larger."""
    image = np.zeros((480, 640, 3), np.uint8)
    paint(image, CAMERA, *balls([(0.0, 0.0, 0.10), (0.0, 0.0, 0.15)], [0.01, 0.03]), order=order, names=False)
    middle, ring = image[240, 320].astype(int), image[240, 320 + 100].astype(int)
    blue = 2 if order == "rgb" else 0
    assert middle[blue] > 20 and middle.sum() == middle[blue]
    assert ring[blue] == 0 and ring.sum() > 40


def below_surface(centre, radius, organ, organ_radius):
    """Least distance of a sphere's points behind an organ that is a sphere, along the rays from the origin."""
    around = np.random.default_rng(0).normal(size=(200_000, 3))
    points = centre + radius * around / np.linalg.norm(around, axis=1, keepdims=True)
    far = np.linalg.norm(points, axis=1)
    along = points @ organ / far
    return (far - (along - np.sqrt(along**2 - organ @ organ + organ_radius**2))).min()


def test_depth_is_the_distance_below_the_surface_along_the_line_of_sight():
    centres, organ = [(0.0, 0.0, 0.20), (0.055, 0.0, 0.22)], (0.0, 0.0, 0.22)
    structures, placed = balls(centres, [0.01, 0.01], surface=(organ, 0.09), subdivisions=5)
    near, side = paint(picture(), CAMERA, structures, placed, names=False)
    assert near.depth_m == pytest.approx(0.19 - 0.13, abs=2e-4)
    assert side.depth_m == pytest.approx(below_surface(centres[1], 0.01, np.array(organ), 0.09), abs=4e-4)
    assert side.depth_m > near.depth_m + 0.01


def test_deeper_is_fainter():
    images = []
    for depth in (0.17, 0.21):
        image = np.zeros((480, 640, 3), np.uint8)
        # As large on the image, as deep below the surface as its depth says.
        structures, placed = balls([(0.0, 0.0, depth)], [0.05 * depth], surface=((0.0, 0.0, 0.23), 0.075))
        paint(image, CAMERA, structures, placed, names=False)
        images.append(image)
    shallow, deep = (int(image[240, 320, 0]) for image in images)
    assert 10 < deep < 0.7 * shallow


def test_nothing_that_is_not_seen_is_drawn():
    image = picture()
    structures, placed = balls([(0.0, 0.0, -0.15), (3.0, 0.0, 0.15)], [0.02, 0.02])
    assert paint(image, CAMERA, structures, placed) == []
    placed.points[:] = np.nan
    assert paint(image, CAMERA, structures, placed) == []
    np.testing.assert_array_equal(image, GREY)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e30, 1e300])
def test_what_is_farther_away_than_numbers_reach_is_not_drawn(far):
    image = picture()
    structures, placed = balls([(far, 0.0, 0.15), (0.0, 0.0, 0.15)], [0.02, 0.02])
    with np.errstate(all="warn"):
        (shown,) = paint(image, CAMERA, structures, placed, names=False)
    assert shown.pixels > 1000
    alone = picture()
    paint(alone, CAMERA, *balls([(0.0, 0.0, 0.15)], [0.02]), names=False)
    np.testing.assert_array_equal(changed(image), changed(alone))


def test_structure_that_reaches_across_the_border_is_drawn_up_to_it():
    image = picture()
    paint(image, CAMERA, *balls([(0.08, 0.0, 0.15)], [0.03]), names=False)
    assert changed(image)[240, 639] and not changed(image)[240, 300]


def test_thin_outline_has_the_colour_and_the_place():
    image = picture()
    structures, placed = balls([(0.0, 0.0, 0.15)], [0.02])
    outline(image, CAMERA, structures, placed.points, (255, 10, 20))
    mask = changed(image)
    assert reach(mask) == pytest.approx(radius_px(0.02, 0.15), abs=1.0)
    assert not mask[240, 320]
    np.testing.assert_array_equal(np.unique(image[mask], axis=0), [[255, 10, 20]])


def test_names_cover_neither_what_is_drawn_nor_one_another():
    covered = np.zeros((480, 640), bool)
    covered[200:280, 250:390] = True
    labels = [Label(f"structure {n} 12 mm", (250, 389, 200, 279), np.ones(3)) for n in range(6)]
    image = picture()
    boxes = write_labels(image, labels, (0, 0), covered)
    assert len(boxes) >= 4 and not (changed(image) & covered)[205:275, 255:385].any()
    for n, (left, top, right, bottom) in enumerate(boxes):
        assert not covered[top:bottom, left:right].any()
        for other in boxes[:n]:
            assert left >= other[2] or right <= other[0] or top >= other[3] or bottom <= other[1]


def test_no_name_is_written_where_the_banner_is():
    image, covered = picture(), np.zeros((480, 640), bool)
    label = Label("vessel", (300, 340, 10, 30), np.ones(3))
    (box,) = write_labels(image, [label], (0, 0), covered)
    (lower,) = write_labels(image, [label], (0, 0), covered, first_row=60)
    assert box[1] < 40 and lower[1] >= 60
    rows = banner_rows(image, "a reason")
    write_banner(image, "DEGRADED", "a reason", (0, 190, 255))
    assert (image[:rows, 600:] != GREY).all() and (image[rows:, 600:] == GREY).all()


def test_name_without_a_place_is_left_out():
    covered = np.ones((480, 640), bool)
    image = picture()
    assert write_labels(image, [Label("vessel", (0, 639, 0, 479), np.ones(3))], (0, 0), covered) == []
    np.testing.assert_array_equal(image, GREY)


@pytest.mark.parametrize("size", [(480, 640), (1080, 1920), (30, 40), (1, 1)])
def test_banner_fits_any_image(size):
    image = np.full((*size, 3), GREY, np.uint8)
    write_banner(image, "DEGRADED", "a reason " * 40 + "Grüße", (0, 190, 255))
    assert changed(image).any()
    if size[0] >= 480:
        np.testing.assert_array_equal(image[-100:], GREY)


def test_structures_that_contradict_themselves_are_refused():
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    rgb = np.zeros((1, 3))
    with pytest.raises(InvalidInputError, match="expected 1 kinds and colours"):
        make_structures(("a",), (), rgb, np.array([0, 3]), np.array([0, 1]), faces)
    with pytest.raises(InvalidInputError, match="at most 255, got 256"):
        make_structures(("a",) * 256, ("b",) * 256, np.zeros((256, 3)), np.zeros(257), np.zeros(257), faces)
    with pytest.raises(InvalidInputError, match="rise from 0"):
        make_structures(("a",), ("b",), rgb, np.array([0, 3]), np.array([0, 2]), faces)
    with pytest.raises(InvalidInputError, match="between its own vertices"):
        make_structures(("a",), ("b",), rgb, np.array([0, 2]), np.array([0, 1]), faces)


def test_same_structures_are_mixed_with_the_next_image_and_drawn_anew_where_anything_changed(monkeypatch):
    drawn = []
    prepare = painter._prepare
    monkeypatch.setattr(painter, "_prepare", lambda *given: drawn.append(given) or prepare(*given))
    structures, placed = balls([(0.0, 0.0, 0.15), (0.02, 0.0, 0.12)], [0.02, 0.01], sigma=0.002)
    other = Placed(placed.points + 0.001, placed.sigma, None)
    kept = painter.Painter(Buffers())
    for number, (where, order, margin_m, anew) in enumerate(
        [
            (placed, "bgr", 0.0, True),
            (placed, "bgr", 0.0, False),
            (placed, "rgb", 0.0, False),
            (other, "rgb", 0.0, True),
            (other, "rgb", 0.01, True),
            (placed, "bgr", 0.0, True),
        ]
    ):
        image, expected = picture() + 10 * number, picture() + 10 * number
        before = len(drawn)
        options = {"order": order, "margin_m": margin_m}
        shown = kept.paint(image, CAMERA, structures, where, **options)
        assert (len(drawn) > before) is anew
        assert repr(shown) == repr(paint(expected, CAMERA, structures, where, **options))
        np.testing.assert_array_equal(image, expected)


def test_nothing_is_kept_of_structures_that_are_not_on_the_image():
    kept = painter.Painter(Buffers())
    behind = balls([(0.0, 0.0, -0.15)], [0.02])
    assert kept.paint(picture(), CAMERA, *behind) == [] == kept.paint(picture(), CAMERA, *behind)
    assert len(kept.paint(picture(), CAMERA, *balls([(0.0, 0.0, 0.15)], [0.02]))) == 1
