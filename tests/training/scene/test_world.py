"""What moves how, and that nothing passes through anything."""

from dataclasses import replace

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.scene.instrument import GRASPER_PORT_M, grasper, held, probe
from softtissue_training.scene.motion import breath
from softtissue_training.scene.spec import Breathing, SceneSpec
from softtissue_training.scene.world import SURFACES
from training.scene_cases import SPEC

TIMES = (0.0, 0.25, 0.5)


@pytest.mark.parametrize("time", TIMES)
def test_nothing_passes_through_the_organ(made, time):
    moment = made.scene.world.at(time)
    organ = moment.part(0)
    gaps = {
        name: signed_distance(organ, moment.part(label).vertices).min()
        for label, name in enumerate(SURFACES)
        if label > 0
    }
    assert min(gaps.values()) > 0.0, gaps
    # Tissue is near, and the probe touches.
    assert gaps["wall"] < 0.02 and gaps["fat"] < 0.02
    assert gaps["probe"] < 0.002


def test_the_camera_is_inside_the_wall_and_outside_of_the_rest(made):
    scene = made.scene
    moment = scene.world.at(0.3)
    lens = scene.path.at(0.3).position[None]
    inside = {name: signed_distance(moment.part(label), lens)[0] < 0 for label, name in enumerate(SURFACES)}
    assert inside == {name: name == "wall" for name in SURFACES}


def test_the_organ_moves_as_the_finite_elements_do_and_the_rest_follows(made):
    world = made.scene.world
    start, later = world.at(0.0), world.at(0.4)
    surface = world.anatomy.surface.vertices
    moved = world.motion.at(world.motion.interpolator.weights(surface), 0.4)
    np.testing.assert_allclose(later.part(0).vertices, surface + moved, atol=1e-12)
    # The steady force is there before the first cloud.
    assert np.linalg.norm(start.part(0).vertices - surface, axis=1).max() > 0.001
    for label in range(len(SURFACES)):
        assert not np.allclose(start.part(label).vertices, later.part(label).vertices, atol=1e-4)
    np.testing.assert_array_equal(start.rest, later.rest)
    np.testing.assert_array_equal(start.mesh.faces, later.mesh.faces)


def test_breath_rests_breathed_out():
    breathing = Breathing(period=4.0)
    assert breath(breathing, 0.0) == pytest.approx(0.0)
    assert breath(breathing, 2.0) == pytest.approx(1.0)
    assert breath(breathing, 5.0) == pytest.approx(breath(breathing, 1.0)) == pytest.approx(0.25)


@pytest.mark.parametrize("opening", [0.0, 0.4])
def test_instruments_are_solid_and_slim(opening):
    for mesh in (grasper(opening), probe()):
        assert enclosed_volume(mesh) > 0.0
        radius = np.linalg.norm(mesh.vertices[mesh.vertices[:, 2] > 0.03, :2], axis=1)
        assert radius.max() < 0.005
        assert np.ptp(mesh.vertices[:, 2]) > 0.2
    jaws = grasper(opening).vertices[:, 1][grasper(opening).vertices[:, 2] < 0.004]
    assert np.ptp(jaws) == pytest.approx(0.0024 + 2 * 0.018 * np.sin(opening), abs=0.003)


def test_instrument_reaches_from_its_port_to_its_tip():
    tip, port = np.array([0.0, -0.06, -0.04]), np.array(GRASPER_PORT_M)
    pose = held(tip, port, roll=0.7)
    np.testing.assert_allclose(pose.position, tip)
    np.testing.assert_allclose(pose.inner(port[None])[0], [0.0, 0.0, np.linalg.norm(port - tip)], atol=1e-12)
    np.testing.assert_allclose(pose.rotation.T @ pose.rotation, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"frames": 0}, "at least 1"),
        ({"points": 0}, "at least 1"),
        ({"tracks": 0}, "at least 1"),
        ({"states": 1}, "at least 2"),
        ({"push_start": 60.0}, "before the last frame"),
    ],
)
def test_settings_without_sense_are_refused(setting, message):
    with pytest.raises(InvalidInputError, match=message):
        replace(SPEC, **setting)
    assert SceneSpec().duration == pytest.approx(10.1)
