"""Calls without end neither stop the answers nor fill the memory; those that are too many are refused in a sentence."""

import time
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_msgs.srv import LoadOrgan, Reset, WarpPoints

from integration.harness import AtRate, running_node, write_organ
from integration.scene import Scene, nanoseconds, stamp_message
from integration.soak import measure

FLOOD_S, CALLS_PER_S = 3.0, 400.0
STREAM_HZ = 20.0
MOST_GAP_S = 1.0
LEAST_ANSWERED = (
    0.25  # of clouds at 20 Hz, while calls, client and the tracker's thread want three cores of two
)
MOST_GROWTH_MB = 60.0  # with the first step after a start


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


@pytest.fixture(scope="module")
def running(folder, tmp_path_factory):
    with running_node(folder, tmp_path_factory.mktemp("node")) as node_and_client:
        yield node_and_client


def stream(client, scene, seconds):
    """Publish clouds for a time; return their stamps."""
    cloud, sent, end = scene.cloud(0), [], time.monotonic() + seconds
    while time.monotonic() < end:
        sent.append(time.time_ns())
        cloud.header.stamp = stamp_message(sent[-1])
        client.clouds.publish(cloud)
        client.spin(1.0 / STREAM_HZ)
    return sent


def settled(client, scene):
    """Status of a cloud that is sent when all is over, on whose way the counts balance."""
    (stamp,) = stream(client, scene, 0.5 / STREAM_HZ)
    status = client.status_of(stamp)
    client.answer_of(stamp)
    assert status.frames_received == status.frames_answered + status.frames_dropped + status.frames_refused
    return status


def load_when_idle(client, folder):
    """Wait until nothing loads any more, and load an organ."""

    def loaded():
        response = client.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(folder)))
        return response.result == LoadOrgan.Response.SUCCESS

    client.wait(loaded, "end of what loads")


KINDS = {
    "load_organ": (LoadOrgan, lambda folder: LoadOrgan.Request(folder=str(folder))),
    "load_organ of a wrong folder": (LoadOrgan, lambda _: LoadOrgan.Request(folder="/nowhere")),
    "warp_points": (WarpPoints, lambda _: WarpPoints.Request(points=np.linspace(0, 0.01, 3000).tolist())),
    "reset": (Reset, lambda _: Reset.Request()),
}


@pytest.mark.alone
@pytest.mark.parametrize("name", KINDS)
def test_flood_of_calls(running, folder, name):
    node, client = running
    kind, make = KINDS[name]
    scene = Scene(folder)
    settled(client, scene)
    client.answers.clear()
    received_s = []
    listening = client.node.create_subscription(
        type(scene.cloud(0)),
        f"{client.name}/deformed_points",
        lambda _: received_s.append(time.monotonic()),
        50,
    )
    before = measure(node.process.pid, 0.0)
    service = client.node.create_client(kind, f"{client.name}/{name.split()[0]}")
    client.wait(service.service_is_ready, "service")
    futures, request = [], make(folder)
    with AtRate(lambda: futures.append(service.call_async(request)), CALLS_PER_S):
        sent = stream(client, scene, FLOOD_S)
    client.spin(0.5)
    during = measure(node.process.pid, FLOOD_S)
    client.node.destroy_subscription(listening)
    gaps = np.diff(received_s)
    assert gaps.max() < MOST_GAP_S and len(received_s) > LEAST_ANSWERED * len(sent)
    assert during["memory_mb"] < before["memory_mb"] + MOST_GROWTH_MB
    assert during["threads"] <= before["threads"] + 3
    responses = [future.result() for future in futures if future.done()]
    results = Counter(response.result for response in responses)
    assert len(responses) > 100, results
    busy = [response.message for response in responses if response.result == kind.Response.BUSY]
    if name != "load_organ of a wrong folder":  # which is refused as fast as it is asked for
        assert len(busy) > 0.3 * len(responses)
    assert all("expected" in message and "got" in message for message in busy)
    assert {nanoseconds(answer.header.stamp) for answer in client.answers} <= set(sent)
    if kind is LoadOrgan:
        load_when_idle(client, folder)
    settled(client, scene)


def test_load_while_another_goes_on_is_refused_and_changes_nothing(running, folder, tmp_path_factory):
    client = running[1]
    bigger = write_organ(tmp_path_factory.mktemp("bigger"), scale=1.2)
    service = client.node.create_client(LoadOrgan, f"{client.name}/load_organ")
    client.wait(service.service_is_ready, "service load_organ")

    load_when_idle(client, folder)
    first = service.call_async(LoadOrgan.Request(folder=str(bigger)))
    second = service.call_async(LoadOrgan.Request(folder=str(folder)))
    client.wait(second.done, "refusal", 2.0)
    assert not first.done()
    assert second.result().result == LoadOrgan.Response.BUSY
    assert "expected one organ at a time" in second.result().message
    client.wait(first.done, "loaded organ", 60.0)
    assert first.result().result == LoadOrgan.Response.SUCCESS
    scene = Scene(bigger)
    settled(client, scene)
    assert client.answers[-1].width == len(scene.organ.structure_points)
