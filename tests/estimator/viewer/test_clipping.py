"""Which triangles lie within what is kept of an organ."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.viewer.clipping import NOTHING_CUT, Clip, bounding_box, kept_faces

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
VERTICES = np.array(BALL.vertices) + np.array([0.3, 0.0, -0.2])
FACES = np.array(BALL.faces, dtype=np.int32)
BOX = bounding_box(VERTICES)


def test_nothing_is_cut_at_first():
    assert kept_faces(NOTHING_CUT, VERTICES, FACES, BOX) is FACES


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_each_side_of_each_axis_is_cut(axis):
    centres = VERTICES[FACES].mean(axis=1)[:, axis]
    middle = BOX[:, axis].mean()
    for share, wanted in (((0.0, 50.0), centres <= middle), ((50.0, 100.0), centres >= middle)):
        clip = Clip(**{"xyz"[axis]: share})
        np.testing.assert_array_equal(kept_faces(clip, VERTICES, FACES, BOX), FACES[wanted])


def test_at_the_end_of_an_axis_what_lies_outside_of_the_box_is_kept():
    moved = VERTICES + np.array([0.2, 0.0, 0.0])
    assert len(kept_faces(Clip(x=(10.0, 100.0)), moved, FACES, BOX)) == len(FACES)
    assert len(kept_faces(Clip(x=(0.0, 90.0)), moved, FACES, BOX)) == 0


def test_flat_organ_is_cut_without_a_division_by_zero():
    flat = VERTICES * [1.0, 1.0, 0.0]
    assert len(kept_faces(Clip(x=(0.0, 50.0), z=(10.0, 100.0)), flat, FACES, bounding_box(flat))) == 0


def test_box_of_nothing_has_no_size():
    assert bounding_box(np.zeros((0, 3))).tolist() == [[0.0] * 3, [0.0] * 3]
