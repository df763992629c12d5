"""The scene's nodes: what they show, and that what was shown leaves nothing behind."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the packages of requirements-viewer.txt are not installed")

from estimator.viewer.moments import POINTS, SURFACE, moment, organ
from softtissue_estimator.viewer.clipping import Clip
from softtissue_estimator.viewer.moment import CameraImage, Lens
from softtissue_estimator.viewer.scene import Look, Scene
from softtissue_estimator.viewer.server import LOOPBACK, PageServer

LOOK = Look(((1, 2, 3), (4, 5, 6)))


@pytest.fixture
def server():
    served = PageServer(LOOPBACK, 0)
    yield served
    served.stop()


def node(server, name):
    return server.scene.get_handle_by_name(name)


def kept_messages(server):
    """What is sent to a page that is opened now."""
    return len(server._websock_server.get_message_buffer().message_from_id)


def seen(time_s, count):
    points = np.linspace(0.0, 0.1, 3 * count, dtype=np.float32).reshape(count, 3)
    return replace(moment(time_s), observed=points, left_out=np.arange(count) < 2)


def test_moment_is_drawn_where_it_is_and_in_its_colours(server):
    scene = Scene(server)
    scene.show(organ(), moment(1.0, shift=0.02), LOOK)
    vein, tumour = node(server, "/structures/0"), node(server, "/structures/1")
    np.testing.assert_allclose(vein.vertices, POINTS[:3] + np.array([0.02, 0.0, 0.0]), atol=1e-7)
    assert (tuple(vein.color), tuple(tumour.color)) == LOOK.colours
    np.testing.assert_allclose(node(server, "/organ").vertices, SURFACE, atol=1e-7)
    assert node(server, "/organ").opacity == LOOK.opacity


def test_nothing_is_visible_after_hiding_and_all_again_afterwards(server):
    scene, structures, shown = Scene(server), organ(), replace(seen(1.0, 5), camera=np.eye(4))
    names = ("/structures/0", "/structures/1", "/organ", "/observed", "/cloud_frame", "/organ_frame")
    scene.show(structures, shown, LOOK)
    assert [node(server, name).visible for name in names] == [True] * 6
    scene.hide()
    assert [node(server, name).visible for name in names] == [False] * 6
    scene.show(structures, shown, LOOK)
    assert [node(server, name).visible for name in names] == [True] * 6
    scene.show(structures, shown, replace(LOOK, observed=False, frames=False))
    assert [node(server, name).visible for name in names] == [True] * 3 + [False] * 3


def test_points_that_are_left_out_are_red(server):
    scene, structures = Scene(server), organ()
    for count in (5, 5, 3, 0, 7):
        scene.show(structures, seen(float(count), count), LOOK)
    colours = node(server, "/observed").colors
    assert len(colours) == 7 and (colours[:2, 0] > 200).all() and (colours[2:, 1] > 200).all()


def test_organ_is_cut_and_the_structures_only_if_asked(server):
    scene, structures = Scene(server), organ()
    scene.show(structures, moment(1.0), LOOK)
    scene.show(structures, moment(2.0), replace(LOOK, clip=Clip(x=(99.0, 100.0))))
    assert len(node(server, "/organ").faces) == 0 and len(node(server, "/structures/0").faces) == 1
    scene.show(structures, moment(3.0), replace(LOOK, clip=Clip(x=(99.0, 100.0), structures=True)))
    assert len(node(server, "/structures/0").faces) == 0
    scene.show(structures, moment(4.0), LOOK)
    assert len(node(server, "/organ").faces) == 4 and len(node(server, "/structures/0").faces) == 1


def test_image_is_in_the_pyramid_of_its_camera(server):
    scene, structures, shown = Scene(server), organ(), replace(moment(1.0), camera=np.eye(4))
    image = CameraImage("eye", np.full((6, 12, 3), 200, np.uint8), Lens(0.5, 2.0))
    scene.show(structures, shown, LOOK, image)
    pyramid = node(server, "/cloud_frame/pyramid")
    assert (pyramid.fov, pyramid.aspect) == (0.5, 2.0) and pyramid.image is image.pixels
    scene.show(structures, shown, LOOK)
    assert pyramid.image is None


def test_another_organ_takes_the_place_of_the_one_before(server):
    scene = Scene(server)
    scene.show(organ(), moment(1.0), LOOK)
    scene.show(organ(), moment(2.0, surface=False), LOOK)
    assert node(server, "/organ") is None
    assert node(server, "/structures/0").vertices.shape == (3, 3)


def test_what_was_shown_leaves_nothing_behind(server):
    scene, structures = Scene(server), organ()
    for number in range(20):
        scene.show(structures, seen(0.1 * number, 5 + number % 3), LOOK)
    before = kept_messages(server)
    for number in range(20, 320):
        scene.show(structures, seen(0.1 * number, 5 + number % 3), LOOK)
        if number % 10 == 0:
            scene.hide()
        if number % 50 == 0:
            structures = organ()
    assert abs(kept_messages(server) - before) <= 10
