"""Which meshes are closed, and which of their triangles face away."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.overlay.facing import away_sign
from softtissue_estimator.overlay.rasteriser import fill_depth
from softtissue_estimator.view.shells import shells_of

SPHERE = trimesh.creation.icosphere(subdivisions=1)
POINTS, FACES = np.array(SPHERE.vertices) + np.array([0.0, 0.0, 5.0]), np.array(SPHERE.faces, dtype=np.int32)
TWICE = np.concatenate([FACES, FACES + len(POINTS)]).astype(np.int32)


def turned(faces, which):
    changed = faces.copy()
    changed[which] = changed[which][:, ::-1]
    return changed


def test_shells_are_told_apart():
    np.testing.assert_array_equal(shells_of(FACES), 0)
    np.testing.assert_array_equal(shells_of(TWICE), [0] * len(FACES) + [1] * len(FACES))


@pytest.mark.parametrize(
    "faces",
    [
        FACES[1:],
        turned(FACES, [3]),
        np.concatenate([FACES, FACES[:1]]),
        np.array([[0, 0, 1]], np.int32),
        np.zeros((0, 3), np.int32),
    ],
    ids=["hole", "one triangle turned", "one twice", "no triangle", "empty"],
)
def test_what_is_not_closed_has_no_shells(faces):
    assert shells_of(faces).shape == (0,)


@pytest.mark.parametrize("inside_out", [False, True])
def test_triangles_that_face_the_camera_are_kept(inside_out):
    faces = turned(FACES, slice(None)) if inside_out else FACES
    away = away_sign(POINTS, faces, shells_of(faces), POINTS)
    assert away == (-1 if inside_out else 1)
    pixels = np.column_stack([20 + 50 * POINTS[:, :2] / POINTS[:, 2:], 1.0 / POINTS[:, 2]]).astype(np.float32)
    all_of_them, kept, behind = np.zeros((3, 40, 40), np.float32)
    fill_depth(pixels, faces, 0, all_of_them)
    fill_depth(pixels, faces, away, kept)
    fill_depth(pixels, faces, -away, behind)
    np.testing.assert_array_equal(kept, all_of_them)
    np.testing.assert_array_equal(behind > 0.0, all_of_them > 0.0)
    assert behind[20, 20] < 0.9 * kept[20, 20]


def test_all_triangles_are_drawn_where_it_is_not_known():
    mixed = np.concatenate([FACES, turned(FACES, slice(None)) + len(POINTS)]).astype(np.int32)
    two = np.concatenate([POINTS, POINTS + np.array([3.0, 0.0, 0.0])])
    assert away_sign(two, TWICE, shells_of(TWICE), two) == 1
    assert away_sign(two, mixed, shells_of(mixed), two) == 0
    assert away_sign(POINTS, FACES[1:], shells_of(FACES[1:]), POINTS) == 0
    unseen = POINTS.copy()
    unseen[4] = np.nan
    assert away_sign(POINTS, FACES, shells_of(FACES), unseen) == 0
