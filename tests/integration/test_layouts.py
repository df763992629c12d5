"""The layouts of RViz and Foxglove against what the node and the overlay really publish, and what they show of it."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_msgs.msg import EstimatorStatus
from visualization_msgs.msg import Marker, MarkerArray

from integration.harness import Client, NodeProcess, executable, write_organ
from integration.layouts import (
    MARKERS,
    foxglove_layout,
    foxglove_topics,
    placed_panels,
    rviz_layout,
    rviz_topics,
)
from integration.scene import Scene
from ros_domain import reserved
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import behind_glass, draw_solid, look_from

SHAPE = 240, 320
LEAST_PIXELS = 30


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Topics of a node, an overlay and a source of clouds with their types, and the markers of an answer."""
    folder = tmp_path_factory.mktemp("organ")
    write_organ(folder)
    scene, markers = Scene(folder), []
    logs = [tmp_path_factory.mktemp(name) for name in ("node", "overlay")]
    with (
        reserved() as domain,
        NodeProcess(domain, logs[0], {"organ": folder, "minimum_visible_fraction": 0.01}),
        NodeProcess(domain, logs[1], {}, [executable("overlay")]) as overlay,
        Client(domain) as client,
    ):
        client.node.create_subscription(MarkerArray, "softtissue_estimator/markers", markers.append, 10)
        client.wait_until_connected()
        overlay.wait_for_text("drawing on images of")
        client.wait(lambda: "softtissue_overlay" in client.node.get_node_names(), "overlay")
        client.clouds.publish(scene.cloud(10**18))
        # Others before them tell viewers to forget what they have.
        shown = client.wait(lambda: next((one for one in markers if len(one.markers) > 1), None), "markers")
        graph = client.node
        topics = {
            name: types[0]
            for name, types in graph.get_topic_names_and_types()
            if graph.get_publishers_info_by_topic(name)
        }
    return topics, shown.markers, scene.organ


def test_rviz_shows_topics_that_are_published_with_their_types(published):
    topics, _, organ = published
    shown = rviz_topics()
    assert shown and {name: types for name, types in shown.items() if topics.get(name) not in types} == {}
    assert rviz_layout()["Global Options"]["Fixed Frame"] == organ.frame


def test_foxglove_shows_topics_that_are_published_with_their_types(published):
    topics, _, organ = published
    shown, fields = foxglove_topics()
    assert shown and {name: types for name, types in shown.items() if topics.get(name) not in types} == {}
    for topic, field, every in fields:
        assert topics[topic] == "softtissue_msgs/msg/EstimatorStatus"
        types = EstimatorStatus.get_fields_and_field_types()
        assert types[field].startswith("sequence<") == every, (topic, field)
    layout = foxglove_layout()
    assert sorted(placed_panels(layout["layout"])) == sorted(layout["configById"])
    assert layout["configById"]["3D!organ"]["followTf"] == organ.frame


def picture(markers, camera):
    """Draw markers as RViz does: what is opaque, behind what is translucent."""
    solid = [one for one in markers if one.color.a == 1.0]
    glass = [one for one in markers if one.color.a < 1.0]
    image = draw_solid([mesh(one) for one in solid], [colour(one) for one in solid], camera)
    for one in glass:
        pane = draw_solid([mesh(one)], [colour(one)], camera)
        pane[..., 3] *= one.color.a
        image = behind_glass(pane, image)
    return image


def mesh(marker):
    points = np.array([[point.x, point.y, point.z] for point in marker.points])
    return SurfaceMesh(points, np.arange(len(points)).reshape(-1, 3))


def colour(marker):
    return np.array([marker.color.r, marker.color.g, marker.color.b])


def test_every_structure_is_seen_where_rviz_looks_from(published):
    _, markers, organ = published
    layouts = rviz_topics(), foxglove_topics()[0]
    assert all(MARKERS in layout["/softtissue_estimator/markers"] for layout in layouts)
    assert [one.ns for one in markers] == [*(one.name for one in organ.structures), organ.name]
    assert all(one.action == Marker.ADD and one.type == Marker.TRIANGLE_LIST for one in markers)
    view = rviz_layout()["Views"]["Current"]
    pitch, yaw = view["Pitch"], view["Yaw"]
    towards = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    camera = look_from(towards, np.array([0.0, 0.0, 1.0]), mesh(markers[-1]).vertices, SHAPE)
    # The whole organ is where the camera looks.
    focus = np.array([view["Focal Point"][axis] for axis in "XYZ"])
    reach = np.linalg.norm(mesh(markers[-1]).vertices - focus, axis=1).max()
    assert view["Near Clip Distance"] < view["Distance"] - reach
    whole = picture(markers, camera)
    for left_out in markers:
        without = picture([one for one in markers if one is not left_out], camera)
        changed = (np.abs(whole - without) > 0.05).any(axis=2).sum()
        assert changed >= LEAST_PIXELS, left_out.ns
