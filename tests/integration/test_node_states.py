"""One node through the states of its life cycle, in the tests' order: what monitors and late comers hear of it."""

import contextlib
import itertools
import os
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures
from softtissue_msgs.srv import LoadOrgan
from visualization_msgs.msg import MarkerArray

from integration.harness import NodeProcess, PlainClient, write_organ
from integration.scene import Scene, nanoseconds
from ros_domain import reserved

SLOW = [sys.executable, str(Path(__file__).with_name("slow_node.py"))]
LOAD_S = 0.8
TIMEOUT_S = 1.0
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
stamps = itertools.count(1_700_000_000_000_000_000, 50_000_000)


class Operator(PlainClient):
    """Somebody who changes states and parameters and looks at diagnostics."""

    def __init__(self, domain):
        super().__init__(domain)
        self.monitored, self.clouds = [], None
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.monitored.append, 10)

    def change(self, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, "change_state", request).success

    def reach(self, wanted):
        """Go to a state from wherever the tests before, if they ran here, left it."""
        states = ["unconfigured", "inactive", "active"]
        up = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
        down = Transition.TRANSITION_CLEANUP, Transition.TRANSITION_DEACTIVATE
        while (now := self.state()) != wanted:
            at, end = states.index(now), states.index(wanted)
            assert self.change(up[at] if at < end else down[at - 1])

    def camera(self):
        """What publishes clouds; it appears when it is first asked for."""
        self.clouds = self.clouds or self.node.create_publisher(PointCloud2, "surface_points", 10)
        return self.clouds

    def state(self):
        return self.call(GetState, "get_state", GetState.Request()).current_state.label

    def set(self, name, text):
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        return self.call(SetParameters, "set_parameters", request).results[0]

    def get(self, name):
        return self.call(GetParameters, "get_parameters", GetParameters.Request(names=[name])).values[0]

    def diagnosed(self, words, timeout=5.0):
        """The next diagnostics whose message holds some words: level, message and values."""
        del self.monitored[:]

        def found():
            statuses = (array.status[0] for array in self.monitored)
            return next((status for status in statuses if words in status.message), None)

        status = self.wait(found, f"diagnostics with {words!r}", timeout)
        return status.level, status.message, {entry.key: entry.value for entry in status.values}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organs") / "small")


@pytest.fixture(scope="module")
def operator(folder, tmp_path_factory):
    os.environ["SLOW_LOAD_S"], os.environ["SLOW_ESTIMATE_S"] = str(LOAD_S), "0.0"
    parameters = {
        "organ": folder,
        "estimator": "slow",
        "autostart": False,
        "minimum_visible_fraction": 0.01,
        "frame_budget_s": 60.0,
        "no_data_timeout_s": TIMEOUT_S,
    }
    log = tmp_path_factory.mktemp("states")
    with (
        reserved() as domain,
        NodeProcess(domain, log, parameters, SLOW) as node,
        Operator(domain) as operator,
    ):
        del os.environ["SLOW_LOAD_S"], os.environ["SLOW_ESTIMATE_S"]
        yield operator
        assert node.stop() == 0
        assert "Traceback" not in node.text


def test_monitors_hear_that_it_is_unconfigured(operator):
    level, _, values = operator.diagnosed("unconfigured", 30.0)
    assert level == DiagnosticStatus.WARN
    assert (values["state"], values["registration age (s)"]) == ("unconfigured", "nan")


def test_unknown_estimator_is_refused_at_once(operator):
    refused = operator.set("estimator", "elastik")
    assert not refused.successful and "elastic" in refused.reason


def test_monitors_hear_why_it_could_not_be_configured(operator, folder):
    operator.reach("unconfigured")
    assert operator.set("organ", str(folder / "nowhere")).successful
    assert not operator.change(Transition.TRANSITION_CONFIGURE)
    level, message, _ = operator.diagnosed("nowhere")
    assert level == DiagnosticStatus.ERROR and message.startswith("unconfigured: organ")
    assert operator.set("organ", str(folder)).successful


def test_services_answer_while_it_is_configured(operator):
    operator.reach("unconfigured")
    client = operator.node.create_client(ChangeState, "softtissue_estimator/change_state")
    operator.wait(client.service_is_ready, "service change_state")
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    began = time.monotonic()
    future = client.call_async(request)
    operator.wait(lambda: operator.state() == "configuring", "state configuring", LOAD_S)
    assert not operator.change(Transition.TRANSITION_CONFIGURE), "one transition at a time"
    assert not operator.set("device", "cuda").successful
    assert not future.done() and time.monotonic() - began < LOAD_S
    assert operator.wait(future.done, "end of the transition") and future.result().success
    assert operator.state() == "inactive"


def test_publisher_that_appears_late_has_its_time(operator):
    operator.reach("active")
    heard = []
    operator.node.create_subscription(EstimatorStatus, "softtissue_estimator/status", heard.append, 10)
    operator.spin(1.5 * TIMEOUT_S)
    operator.camera()
    operator.spin(0.8 * TIMEOUT_S)
    assert heard == []
    operator.wait(lambda: heard, "complaint of silence", 4.0)
    assert "expected a cloud" in heard[0].reason


def test_late_comers_have_the_newest_status_and_markers(operator, folder):
    operator.reach("active")
    operator.wait(lambda: operator.camera().get_subscription_count(), "the node as a listener")
    level = None
    for _ in range(6):  # diagnostics come once a second, and a second after a cloud they complain of silence
        stamp = next(stamps)
        operator.camera().publish(Scene(folder).cloud(stamp))
        with contextlib.suppress(AssertionError):
            level = operator.diagnosed("ok", 1.5)[0]
            break
    assert level == DiagnosticStatus.OK
    statuses, markers, described = [], [], []
    operator.node.create_subscription(Structures, "softtissue_estimator/structures", described.append, KEPT)
    operator.node.create_subscription(EstimatorStatus, "softtissue_estimator/status", statuses.append, KEPT)
    operator.node.create_subscription(MarkerArray, "softtissue_estimator/markers", markers.append, KEPT)
    # The first of the markers is what the beginning of the activity left there: nothing to see.
    operator.wait(
        lambda: statuses and described and markers and len(markers[-1].markers) > 1,
        "what was published before",
        5.0,
    )
    assert described[-1].names == ["tumour", "vessel"]
    assert nanoseconds(statuses[-1].header.stamp) == stamp
    (shown,) = {nanoseconds(marker.header.stamp) for marker in markers[-1].markers}
    assert shown == stamp
    assert markers[-1].markers[0].lifetime.sec == TIMEOUT_S


def test_organ_that_was_loaded_is_the_one_that_is_configured_again(operator, folder):
    operator.reach("active")
    described = []
    operator.node.create_subscription(Structures, "softtissue_estimator/structures", described.append, KEPT)
    other = write_organ(folder.parent / "large", scale=1.2)
    text = (other / "organ.yaml").read_text()
    (other / "organ.yaml").write_text(text.replace("Test organ", "Large organ"))
    response = operator.call(LoadOrgan, "load_organ", LoadOrgan.Request(folder=str(other)))
    assert response.result == LoadOrgan.Response.SUCCESS, response.message
    operator.wait(lambda: described and described[-1].organ == "Large organ", "its structures", 5.0)
    assert operator.get("organ").string_value == str(other)
    assert operator.change(Transition.TRANSITION_DEACTIVATE)
    assert operator.diagnosed("inactive")[0] == DiagnosticStatus.WARN
    assert operator.change(Transition.TRANSITION_CLEANUP)
    assert operator.change(Transition.TRANSITION_CONFIGURE)
    assert operator.diagnosed("inactive")[2]["organ"] == "Large organ"


def test_monitors_hear_that_it_is_finalized(operator):
    operator.reach("inactive")
    assert operator.change(Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert operator.diagnosed("finalized")[0] == DiagnosticStatus.ERROR
