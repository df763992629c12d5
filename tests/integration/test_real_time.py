"""The node under load: it stays answerable while it computes, and a minute at 60 Hz is like a second.

SOFTTISSUE_SOAK_S sets for how long clouds come at 60 Hz (s); 120 is the length that the product promises.
"""

import itertools
import os
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rcl_interfaces.srv import GetParameters
from softtissue_msgs.srv import WarpPoints

from integration.harness import AtRate, Client, NodeProcess, write_organ
from integration.scene import Scene, nanoseconds, stamp_message

SOAK_S = float(os.environ.get("SOFTTISSUE_SOAK_S", "5"))
RATE_HZ = 60.0
ASKING_S = 2.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


class Stream(AtRate):
    """Publishes a cloud at a rate; the stamps are the time, nanoseconds."""

    def __init__(self, client, cloud, rate_hz):
        super().__init__(self._publish, rate_hz)
        self.sent, self._client, self._cloud = [], client, cloud

    def _publish(self):
        self.sent.append(time.time_ns())
        self._cloud.header.stamp = stamp_message(self.sent[-1])
        self._client.clouds.publish(self._cloud)


@pytest.mark.alone
def test_parameters_and_services_answer_while_inference_runs(folder, tmp_path, domain):
    scene = Scene(folder, points=1000)
    parameters = {"organ": folder, "estimator": "paper", "frame_budget_s": 60.0}
    with NodeProcess(domain, tmp_path, parameters) as node, Client(domain) as client:
        client.wait_until_connected()
        get = client.node.create_client(GetParameters, f"{client.name}/get_parameters")
        warp = client.node.create_client(WarpPoints, f"{client.name}/warp_points")
        points = WarpPoints.Request(points=np.linspace(0.0, 0.01, 300).tolist())
        points.header.frame_id = "organ"
        questions = [(get, GetParameters.Request(names=["estimator"])), (warp, points)]
        with Stream(client, scene.cloud(0), 300.0):
            client.wait(lambda: client.answers, "first answer")
            for service, _ in questions:
                client.wait(service.service_is_ready, service.srv_name)
            waited = {service.srv_name: [] for service, _ in questions}
            began = time.monotonic()
            for service, request in itertools.cycle(questions):
                asked = time.monotonic()
                if asked - began > ASKING_S:
                    break
                future = service.call_async(request)
                client.wait(future.done, service.srv_name)
                waited[service.srv_name].append(time.monotonic() - asked)
                assert future.result() is not None
                client.spin(0.01)
        client.spin(1.0)
        busy = [dict(zip(s.stage_names, s.stage_seconds, strict=True)) for s in client.statuses]
        assert "Traceback" not in node.text
    estimates = [stages["estimate"] for stages in busy if "estimate" in stages]
    # Alone on two cores it is most of the time; receiving 300 clouds a second takes its share where others compute too.
    assert sum(estimates) > 0.1 * ASKING_S, "inference was at work while it was asked"
    for name, seconds in waited.items():
        # Half of them, because a test shares its cores with others; docs/reference/numbers.md has the largest.
        assert np.median(seconds) < 0.05, f"{name}: {np.sort(seconds).round(4)}"


@pytest.mark.alone
@pytest.mark.timeout(120 + 2 * SOAK_S)
def test_sixty_clouds_a_second(folder, tmp_path, domain):
    scene = Scene(folder, points=10_000)
    with (
        NodeProcess(domain, tmp_path, {"organ": folder, "frame_budget_s": 60.0}) as node,
        Client(domain) as client,
    ):
        client.wait_until_connected()
        latency = {}
        client.node.create_subscription(
            type(scene.cloud(0)),
            f"{client.name}/deformed_points",
            lambda message: latency.setdefault(
                nanoseconds(message.header.stamp), (time.time_ns() - nanoseconds(message.header.stamp)) / 1e9
            ),
            100,
        )
        with Stream(client, scene.cloud(0), RATE_HZ) as stream:
            client.spin(SOAK_S)
        client.status_of(stream.sent[-1], timeout=20.0)
        client.spin(0.5)
        assert "Traceback" not in node.text
    status = client.statuses[-1]  # the one before may have been told of the last cloud already, too
    assert len(stream.sent) >= 0.9 * SOAK_S * RATE_HZ
    assert set(latency) <= set(stream.sent)
    assert status.frames_received == len(stream.sent), "none lost on the way"
    assert status.frames_answered + status.frames_dropped == len(stream.sent)
    assert (status.frames_answered, status.frames_refused) == (len(latency), 0)
    # Newest first: the order of the answers is that of the clouds, and they do not age with the stream.
    assert list(latency) == sorted(latency)
    ages = np.array(list(latency.values()))
    third = len(ages) // 3
    assert np.median(ages[-third:]) < 1.5 * np.median(ages[third:-third]) + 0.01
