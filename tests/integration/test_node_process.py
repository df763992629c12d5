"""The node as a process: signals, exit codes, life cycle, services and what it does when clouds come too fast."""

import itertools
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from softtissue_msgs.msg import Distances
from softtissue_msgs.srv import Distance, LoadOrgan, Reset, WarpPoints

from integration.harness import Client, NodeProcess, executable, write_organ
from integration.scene import CAMERA_FROM_ORGAN, Scene, nanoseconds, read_answer, registration_message
from memory_pools import pools_of
from ros_domain import reserved
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.support.resources import bundled_bag

stamps = itertools.count(1_700_000_000_000_000_000, 50_000_000)
SLOW = [sys.executable, str(Path(__file__).with_name("slow_node.py"))]
LENIENT = {"minimum_visible_fraction": 0.01, "frame_budget_s": 60.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


@pytest.fixture(scope="module")
def scene(folder):
    return Scene(folder)


@pytest.fixture
def slow(folder, tmp_path, monkeypatch):
    """Start a node whose estimates take `estimate_s`."""

    def start(domain, estimate_s, **parameters):
        monkeypatch.setenv("SLOW_ESTIMATE_S", str(estimate_s))
        return NodeProcess(
            domain, tmp_path, {"organ": folder, "estimator": "slow"} | LENIENT | parameters, SLOW
        )

    return start


def ends_amid_clouds(node, client, scene, number):
    """A stream, so that the signal meets callbacks as well as an estimate."""
    for _ in range(20):
        client.clouds.publish(scene.cloud(next(stamps)))
        client.spin(0.02)
    node.send(number)
    for _ in range(20):
        client.clouds.publish(scene.cloud(next(stamps)))
        time.sleep(0.01)
    assert node.wait(15.0) == 0
    assert "Traceback" not in node.text and "Error" not in node.text


def test_signal_while_an_organ_loads_ends_with_zero(slow, monkeypatch, domain):
    monkeypatch.setenv("SLOW_LOAD_S", "60")
    with slow(domain, 0.0) as node:
        node.wait_for_text("slow to load")
        assert node.stop(signal.SIGTERM) == 0
        assert "Traceback" not in node.text


def test_life_cycle_by_services(slow, scene, folder, tmp_path, domain):
    overrides = {
        "qos_overrides./surface_points.subscription.reliability": "reliable",
        "qos_overrides./softtissue_estimator/status.publisher.durability": "volatile",
    }
    with slow(domain, 0.0, autostart=False, **overrides) as node, Client(domain) as client:

        def change(transition):
            request = ChangeState.Request(transition=Transition(id=transition))
            return client.call(ChangeState, "change_state", request).success

        def state():
            return client.call(GetState, "get_state", GetState.Request()).current_state.id

        def set_parameter(name, text):
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
            request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
            return client.call(SetParameters, "set_parameters", request).results[0]

        warp = WarpPoints.Request(points=[0.0, 0.0, 0.0])
        assert state() == State.PRIMARY_STATE_UNCONFIGURED
        (status,) = client.node.get_publishers_info_by_topic("/softtissue_estimator/status")
        assert status.qos_profile.durability == DurabilityPolicy.VOLATILE
        response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(folder)))
        assert response.result == LoadOrgan.Response.NOT_CONFIGURED
        assert client.call(Reset, "reset", Reset.Request()).result == Reset.Response.NOT_CONFIGURED
        assert set_parameter("organ", str(tmp_path / "nowhere")).successful
        assert not change(Transition.TRANSITION_CONFIGURE)
        node.wait_for_text("nowhere")
        assert state() == State.PRIMARY_STATE_UNCONFIGURED

        assert set_parameter("organ", str(folder)).successful
        assert change(Transition.TRANSITION_CONFIGURE)
        assert state() == State.PRIMARY_STATE_INACTIVE
        assert client.call(WarpPoints, "warp_points", warp).result == WarpPoints.Response.NOT_ACTIVE
        refusal = set_parameter("estimator", "elastic")
        assert not refusal.successful and "unconfigured" in refusal.reason

        for _ in range(2):  # activation works again and again
            assert change(Transition.TRANSITION_ACTIVATE)
            assert state() == State.PRIMARY_STATE_ACTIVE
            client.wait_until_connected()
            (clouds,) = client.node.get_subscriptions_info_by_topic("/surface_points")
            assert clouds.qos_profile.reliability == ReliabilityPolicy.RELIABLE
            stamp = next(stamps)
            client.clouds.publish(scene.cloud(stamp))
            client.answer_of(stamp)
            assert client.status_of(stamp).frames_received == 1
            assert change(Transition.TRANSITION_DEACTIVATE)
            client.wait(lambda: client.clouds.get_subscription_count() == 0, "end of the subscription")
        assert change(Transition.TRANSITION_CLEANUP)
        assert state() == State.PRIMARY_STATE_UNCONFIGURED
        assert change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
        assert node.stop() == 0
        assert "Traceback" not in node.text


def test_newest_cloud_wins_every_cloud_is_counted_and_a_signal_ends_it(slow, scene, domain):
    sent = []
    with slow(domain, 0.25) as node, Client(domain) as client:
        client.wait_until_connected()
        began = time.monotonic()
        for _ in range(40):
            sent.append(next(stamps))
            client.clouds.publish(scene.cloud(sent[-1]))
            client.spin(0.03)
        last = client.status_of(sent[-1])
        client.answer_of(sent[-1])
        elapsed = time.monotonic() - began
        answered = [nanoseconds(answer.header.stamp) for answer in client.answers]
        ends_amid_clouds(node, client, scene, signal.SIGINT)
    assert answered == sorted(set(answered)), "never an old cloud after a newer one, never one twice"
    assert set(answered) <= set(sent)
    assert (last.frames_received, last.frames_answered) == (len(sent), len(answered))
    assert last.frames_answered + last.frames_dropped == len(sent)
    assert last.frames_refused == 0
    assert 3 <= len(answered) <= elapsed / 0.25  # at least 1.2 s of clouds at 0.25 s each


def test_services_and_parameters_answer_while_an_estimate_runs_and_a_signal_ends_it(slow, scene, domain):
    with slow(domain, 30.0) as node, Client(domain) as client:
        client.wait_until_connected()
        client.clouds.publish(scene.cloud(next(stamps)))
        client.spin(0.5)
        began = time.monotonic()
        names = GetParameters.Request(names=["estimator"])
        assert client.call(GetParameters, "get_parameters", names).values[0].string_value == "slow"
        response = client.call(WarpPoints, "warp_points", WarpPoints.Request(points=[0.0, 0.0, 0.0]))
        assert response.result == WarpPoints.Response.NO_ESTIMATE
        assert time.monotonic() - began < 20.0, "while the estimate still runs"
        assert not client.answers
        ends_amid_clouds(node, client, scene, signal.SIGTERM)


@pytest.fixture(scope="module")
def elastic(folder, tmp_path_factory):
    """A node with the elastic estimator and its client, shared by the tests of the services."""
    parameters = {"organ": folder, "estimator": "elastic"} | LENIENT
    with (
        reserved() as domain,
        NodeProcess(domain, tmp_path_factory.mktemp("elastic"), parameters) as node,
        Client(domain) as client,
    ):
        client.wait_until_connected()
        yield node, client


@pytest.mark.skipif(sys.platform != "linux", reason="reads the map of Linux")
def test_all_threads_take_memory_from_one_pool(elastic):
    assert pools_of(elastic[0].process.pid) == 0


def test_warp_points_follows_the_answer(elastic, scene):
    client = elastic[1]
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    answer = read_answer(client.answer_of(stamp))
    reference = scene.organ.structure_points
    request = WarpPoints.Request(points=reference.ravel().tolist())
    response = client.call(WarpPoints, "warp_points", request)
    assert response.result == WarpPoints.Response.SUCCESS
    assert (nanoseconds(response.header.stamp), response.header.frame_id) == (stamp, "organ")
    moved = np.asarray(response.points).reshape(-1, 3)
    np.testing.assert_allclose(moved[:, 2], answer["z"], atol=2e-4)
    np.testing.assert_allclose(moved - np.asarray(response.displacement).reshape(-1, 3), reference, atol=1e-9)
    assert len(response.sigma) == len(reference)

    # The same points, given in the camera's frame.
    client.registrations.publish(registration_message(CAMERA_FROM_ORGAN))
    client.spin(0.3)
    seen = reference @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]
    request = WarpPoints.Request(points=seen.ravel().tolist())
    request.header.frame_id = "camera"
    response = client.call(WarpPoints, "warp_points", request)
    assert response.header.frame_id == "organ"
    np.testing.assert_allclose(np.asarray(response.points).reshape(-1, 3), moved, atol=1e-6)


def test_tool_hears_how_far_it_is_from_the_answer(elastic, scene):
    client, heard = elastic[1], []
    listener = client.node.create_subscription(Distances, f"{client.name}/tool_distances", heard.append, 10)
    tools = client.node.create_publisher(PoseStamped, "tool", 10)
    client.wait(lambda: tools.get_subscription_count() and listener.get_publisher_count(), "tool's topics")
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    answer = read_answer(client.answer_of(stamp))
    tumour = np.stack([answer[name][answer["structure"] == 0] for name in "xyz"], axis=1).astype(float)
    tool = PoseStamped()
    tool.header.frame_id, tool.header.stamp = "organ", time_message(stamp)
    tip = tumour.mean(axis=0) + np.array([0.0, 0.0, 0.03])
    tool.pose.position.x, tool.pose.position.y, tool.pose.position.z = tip.tolist()
    tool.pose.orientation.x, tool.pose.orientation.w = (
        1.0,
        0.0,
    )  # half a turn: the axis points down, at the tumour
    response = client.call(Distance, "distance", Distance.Request(tool=tool))
    assert response.result == Distance.Response.SUCCESS, response.message

    def told():
        tools.publish(tool)
        client.spin(0.1)
        return heard

    client.wait(told, "distances")
    for found in (heard[0], response.distances):
        assert (found.names, found.kinds) == (["tumour", "vessel"], ["tumour", "vessel"])
        assert (nanoseconds(found.header.stamp), nanoseconds(found.estimate_stamp)) == (stamp, stamp)
        # A ball of 8 mm; the registration's estimated error is taken out besides.
        assert found.distance[0] == pytest.approx(0.03 - 0.008, abs=0.002)
        assert found.distance[0] == pytest.approx(np.linalg.norm(tumour - tip, axis=1).min(), abs=0.002)
        assert found.ahead[0] == pytest.approx(found.distance[0], abs=0.001)
        assert 0.0 < found.sigma[0] < 0.02
        assert 1e-8 < np.trace(np.reshape(found.covariance, (2, 3, 3))[0]) < 3.0 * 0.02**2
    np.testing.assert_allclose(heard[0].distance, response.distances.distance, atol=1e-9)
    tool.header.frame_id = "moon"
    response = client.call(Distance, "distance", Distance.Request(tool=tool))
    assert response.result == Distance.Response.WRONG_FRAME and "'moon'" in response.message


def test_warp_points_refuses_in_a_sentence(elastic, scene):
    client = elastic[1]
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    client.answer_of(stamp)
    codes = WarpPoints.Response

    def ask(points, frame=""):
        request = WarpPoints.Request(points=points)
        request.header.frame_id = frame
        response = client.call(WarpPoints, "warp_points", request)
        assert "expected" in response.message and "got" in response.message
        return response.result

    assert ask([0.0, 0.0]) == codes.INVALID_POINTS
    assert ask([0.0, 0.0, float("nan")]) == codes.INVALID_POINTS
    assert ask([0.0, 0.0, 0.0], "moon") == codes.WRONG_FRAME
    client.clouds.publish(scene.cloud(bad := next(stamps), frame="moon"))
    client.status_of(bad)
    assert ask([0.0, 0.0, 0.0]) == codes.NO_ESTIMATE, "a refused cloud leaves no estimate to rely on"


def test_reset_forgets_the_estimate_and_the_counts(elastic, scene):
    client = elastic[1]
    client.clouds.publish(scene.cloud(stamp := next(stamps)))
    client.answer_of(stamp)
    assert client.call(Reset, "reset", Reset.Request()).result == Reset.Response.SUCCESS
    response = client.call(WarpPoints, "warp_points", WarpPoints.Request(points=[0.0, 0.0, 0.0]))
    assert response.result == WarpPoints.Response.NO_ESTIMATE
    client.clouds.publish(scene.cloud(stamp := next(stamps)))
    status = client.status_of(stamp)
    assert (status.frames_received, status.frames_answered) == (1, 1)


def test_load_organ_changes_the_organ_while_clouds_are_answered(elastic, scene, tmp_path):
    client = elastic[1]
    bigger = write_organ(tmp_path / "bigger", scale=1.2)
    request = LoadOrgan.Request(folder=str(bigger))
    loader = client.node.create_client(LoadOrgan, "softtissue_estimator/load_organ")
    client.wait(loader.service_is_ready, "service load_organ")
    future = loader.call_async(request)
    before = len(client.answers)
    end = time.monotonic() + 60.0
    while not future.done() and time.monotonic() < end:
        client.clouds.publish(scene.cloud(next(stamps)))
        client.spin(0.05)
    answered = len(client.answers) - before
    response = client.wait(future.done, "response of load_organ", 60.0) and future.result()
    assert response.result == LoadOrgan.Response.SUCCESS, response.message
    assert answered >= 3, "the old organ goes on answering while the new one is prepared"
    expected = Scene(bigger)
    assert (response.name, response.structures) == ("Test organ", 2)
    assert response.vertices == len(expected.organ.query_points)
    client.clouds.publish(expected.cloud(stamp := next(stamps)))
    points = read_answer(client.answer_of(stamp))
    np.testing.assert_allclose(points["x"] - points["dx"], expected.organ.structure_points[:, 0], atol=1e-7)

    (bigger / "surface.ply").unlink()
    response = client.call(LoadOrgan, "load_organ", request)
    assert response.result == LoadOrgan.Response.INVALID_ORGAN
    assert "surface.ply" in response.message
    client.clouds.publish(expected.cloud(stamp := next(stamps)))
    client.answer_of(stamp)  # the organ from before is still at work


def test_signal_when_idle_ends_with_zero(elastic):
    node = elastic[0]  # the last test that needs it
    assert node.stop(signal.SIGTERM) == 0
    assert "Traceback" not in node.text and "Error" not in node.text


def test_registration_kept_by_its_publisher_reaches_a_node_that_starts_later(slow, scene, domain):
    with Client(domain) as client:
        client.node.destroy_publisher(client.registrations)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        message = registration_message(CAMERA_FROM_ORGAN)
        client.registrations = client.node.create_publisher(type(message), "registration", kept)
        client.registrations.publish(message)
        with slow(domain, 0.0):
            client.wait_until_connected()
            seen = scene.points @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]

            def answered():
                client.clouds.publish(scene.cloud(next(stamps), frame="camera", points=seen))
                client.spin(0.2)
                return client.answers

            client.wait(answered, "answer to a registered cloud", 10.0)


def test_clouds_of_a_bag_that_does_not_wait_are_counted_or_told(slow, tmp_path, domain):
    with slow(domain, 0.0) as node, Client(domain) as client:
        client.wait_until_connected()
        client.node.destroy_publisher(client.clouds)
        (tmp_path / "replay").mkdir()
        fast = [executable("replay"), bundled_bag(), "--rate", "4", "--subscribers", "0"]
        with NodeProcess(domain, tmp_path / "replay", {}, fast) as player:
            assert player.wait(60.0) == 0, player.text

        def received():
            return client.statuses[-1].frames_received if client.statuses else 0

        def unheard():
            told = re.search(r"(\d+) were sent before it was discovered", node.text)
            return int(told[1]) if told else 0

        client.wait(lambda: received() + unheard() == 100, "count of all clouds", 10.0)
        assert received() > 0


def test_announced_clouds_that_do_not_arrive_are_reported(slow, domain):
    with slow(domain, 0.0, no_data_timeout_s=0.5) as node, Client(domain) as client:
        client.wait_until_connected()
        reason = client.wait(lambda: [s.reason for s in client.statuses if s.level == 2], "status", 10.0)[0]
        assert "/surface_points: expected a cloud" in reason and "FASTDDS_DEFAULT_PROFILES_FILE" in reason
        node.wait_for_text("FASTDDS_DEFAULT_PROFILES_FILE", 5.0)


def test_network_answers_with_weights_of_its_own(folder, scene, tmp_path, domain):
    torch = pytest.importorskip("torch")
    from softtissue_estimator.estimators.paper.checkpoint import save_checkpoint
    from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
    from softtissue_estimator.estimators.paper.network_spec import NetworkSpec

    torch.manual_seed(0)
    spec = NetworkSpec(spacing=0.008, margin_cells=2, architecture=UNetArchitecture(widths=(4, 4, 4, 8)))
    save_checkpoint(tmp_path / "small.safetensors", UNet(spec.architecture), spec, {})
    parameters = {"organ": folder, "estimator": "paper", "device": "cpu"} | LENIENT
    parameters["checkpoint"] = tmp_path / "small.safetensors"
    with NodeProcess(domain, tmp_path, parameters) as node, Client(domain) as client:
        client.wait_until_connected()
        client.clouds.publish(scene.cloud(stamp := next(stamps)))
        points = read_answer(client.answer_of(stamp))
        status = client.status_of(stamp)
        assert (status.estimator, status.device) == ("paper", "cpu")
        assert np.isnan(points["sigma"]).all(), "the paper's network says nothing about its error"
        assert np.isfinite(points["dx"]).all() and np.abs(points["dx"]).max() > 0.0
        response = client.call(WarpPoints, "warp_points", WarpPoints.Request(points=[0.0, 0.0, 0.0]))
        assert response.result == WarpPoints.Response.SUCCESS and np.isnan(response.sigma[0])
        assert node.stop(signal.SIGTERM) == 0
