"""Pictures of what the node published: where things are, and what cannot be drawn."""

import numpy as np
import pytest

from estimator.overlay.ball import balls
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.view.answer_picture import AnswerView, camera_of, draw_answer, png_of

NOTHING = np.zeros((0, 3))


def view(centre=(0.0, 0.0, 0.0), surface=True, observed=NOTHING):
    structures, placed = balls([centre], [0.01], surface=((0.0, 0.0, 0.0), 0.05))
    return AnswerView(structures, placed.points, placed.surface if surface else NOTHING, observed)


def blue(image):
    """Mean row and column of what has the structure's colour."""
    rows, columns = np.nonzero((image[..., 2] > image[..., 0] + 0.3) & (image[..., 3] > 0.5))
    assert len(rows) > 100
    return rows.mean(), columns.mean()


def test_structure_is_drawn_where_it_is():
    views = [view((0.02, 0.0, 0.02)), view((-0.02, 0.0, -0.02))]
    camera = camera_of(views)
    (upper, left), (lower, right) = (blue(draw_answer(one, camera)) for one in views)
    rows, columns = (length / 2 for length in camera.shape)
    # From the front the patient's left is on the right side and the head above.
    assert upper < rows / 2 < lower and right < columns / 2 < left


def test_observed_points_are_green_and_those_beside_the_image_are_left_out():
    points = np.array([[0.03, -0.04, 0.0], [9.0, 9.0, 9.0], [np.nan, 0.0, 0.0]])
    seen, unseen = view(observed=points), view()
    camera = camera_of([seen])
    changed = (draw_answer(seen, camera) != draw_answer(unseen, camera)).any(axis=-1)
    column, row, _ = camera.project(points[:1])[0]
    assert changed.sum() == 9 and changed[int(row / 2), int(column / 2)]


def test_without_a_surface_the_structures_are_drawn():
    one = view(surface=False)
    image = draw_answer(one, camera_of([one]))
    assert blue(image) and (image[..., 3] == 0.0).any()


def test_picture_is_a_png_file():
    one = view()
    assert png_of(draw_answer(one, camera_of([one]))).startswith(b"\x89PNG\r\n")


@pytest.mark.parametrize("change", [lambda p: p[:-1], lambda p: p * np.nan, lambda p: p + 1e6])
def test_vertices_that_cannot_be_drawn_are_a_sentence(change):
    one = view()
    with pytest.raises(InvalidInputError, match="^picture: expected .*vertices.*, got"):
        AnswerView(one.structures, change(one.points), one.surface, NOTHING)


def test_surface_of_another_organ_is_a_sentence():
    one = view()
    with pytest.raises(InvalidInputError, match="vertices of the surface, got 10$"):
        AnswerView(one.structures, one.points, one.surface[:10], NOTHING)


def test_organ_in_one_place_is_a_sentence():
    one = view()
    flat = AnswerView(one.structures, 0.0 * one.points, NOTHING, NOTHING)
    with pytest.raises(InvalidInputError, match="apart"):
        camera_of([flat])
