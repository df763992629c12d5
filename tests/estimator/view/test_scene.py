from dataclasses import replace

import numpy as np
import pytest

from estimator.drawn_scene import SHIFT, ball_scene
from softtissue_estimator.errors import InvalidInputError


@pytest.fixture(scope="module")
def scene():
    return ball_scene()


def test_estimate_of_the_structures_alone_takes_the_true_surface_if_there_is_one(scene):
    alone = replace(scene, estimated=scene.estimated[: len(scene.organ.structure_points)])
    np.testing.assert_allclose(alone.surface.vertices, scene.organ.surface.vertices + SHIFT)
    np.testing.assert_allclose(scene.surface.vertices, scene.organ.surface.vertices + 0.9 * SHIFT)
    assert replace(alone, true=None).surface is None


def test_structures_take_their_own_positions_in_order(scene):
    tumour, vessel = scene.structures(scene.estimated)
    np.testing.assert_allclose(
        tumour.vertices.mean(axis=0), np.array([0.01, 0, 0.02]) + 0.9 * SHIFT, atol=1e-6
    )
    np.testing.assert_allclose(vessel.vertices.mean(axis=0), np.array([-0.02, 0, 0]) + 0.9 * SHIFT, atol=1e-6)


@pytest.mark.parametrize("name", ["estimated", "true"])
def test_positions_that_do_not_fit_the_organ_are_refused(scene, name):
    with pytest.raises(InvalidInputError, match=rf"{name} positions: expected shape .*, got \(5, 3\)"):
        replace(scene, **{name: np.zeros((5, 3))})
