"""Parts of the node that need no running node: pairing, latest wins, silence, registration, parameters, score."""

import ast
import dataclasses
import importlib.util
import os
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.parameter import Parameter

from integration.harness import CAMERA_FROM_ORGAN, registration_message
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.latest_worker import LatestWorker
from softtissue_estimator.ros import parameters, scoring, transport
from softtissue_estimator.ros.counters import FrameCounters, LossCounter
from softtissue_estimator.ros.pairing import StampMatcher
from softtissue_estimator.ros.registration import Registration, tf_source, transform_points
from softtissue_estimator.ros.throttle import Throttle
from softtissue_estimator.ros.watchdog import silence

PACKAGE = Path(__file__).parents[2] / "softtissue_estimator"


def clouds(entries):
    return [entry.cloud for entry in entries]


def test_pairs_match_in_either_order():
    matcher = StampMatcher()
    assert matcher.add_cloud(5, "cloud 5", 0.0).matched is None
    waiting, pairs = matcher.add_pairs(5, "pairs 5").matched
    assert (waiting.cloud, waiting.received_s, pairs) == ("cloud 5", 0.0, "pairs 5")
    assert matcher.add_pairs(6, "pairs 6").matched is None
    assert matcher.add_cloud(6, "cloud 6", 1.0).matched[0].cloud == "cloud 6"
    assert matcher.waiting == 0


def test_match_passes_over_older_clouds_only():
    matcher = StampMatcher()
    for stamp in (1, 2, 3):
        matcher.add_cloud(stamp, f"cloud {stamp}", 0.0)
    outcome = matcher.add_pairs(2, "pairs")
    assert outcome.matched[0].cloud == "cloud 2"
    assert clouds(outcome.passed_over) == ["cloud 1"]
    assert matcher.waiting == 1


def test_buffers_are_bounded_and_nothing_vanishes():
    matcher = StampMatcher(capacity=2)
    lost = [clouds(matcher.add_cloud(stamp, stamp, 0.0).unmatched) for stamp in range(5)]
    assert lost == [[], [], [0], [1], [2]]
    for stamp in range(10, 15):
        matcher.add_pairs(stamp, stamp)
    assert matcher.add_cloud(10, "too late", 0.0).matched is None
    assert matcher.add_cloud(14, "in time", 0.0).matched is not None


def test_cloud_waits_no_longer_than_its_patience():
    matcher = StampMatcher(patience_s=0.5)
    matcher.add_cloud(1, "cloud", 10.0)
    assert matcher.expire(10.4).unmatched == []
    assert clouds(matcher.expire(10.6).unmatched) == ["cloud"]
    assert matcher.waiting == 0


def test_repeated_stamp_replaces_the_cloud_that_waits():
    matcher = StampMatcher()
    matcher.add_cloud(1, "first", 0.0)
    assert clouds(matcher.add_cloud(1, "second", 0.0).passed_over) == ["first"]
    assert matcher.add_pairs(1, "pairs").matched[0].cloud == "second"


def test_worker_takes_the_newest_and_hands_back_the_replaced():
    release, begun, done = threading.Event(), threading.Event(), []

    def work(item):
        begun.set()
        assert release.wait(10.0)
        done.append(item)

    crashes = []
    worker = LatestWorker(work, crashes.append)
    assert worker.put(1) is None
    assert begun.wait(10.0)
    assert worker.put(2) is None
    assert worker.put(3) == 2
    release.set()
    end = time.monotonic() + 10.0
    while len(done) < 2 and time.monotonic() < end:
        time.sleep(0.001)
    assert worker.stop(10.0)
    assert (done, crashes) == ([1, 3], [])


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads have no priority of their own")
def test_worker_in_the_background_leaves_the_processor_to_others():
    def priority(background):
        found, done = [], threading.Event()

        def work(_item):
            found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
            done.set()

        worker = LatestWorker(work, found.append, background=background)
        worker.put(1)
        assert done.wait(5.0)
        assert worker.stop(5.0)
        return found[0]

    here = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert priority(False) == here < priority(True)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == here


def test_worker_reports_a_crash():
    crashes, reported = [], threading.Event()

    def crash(error):
        crashes.append(error)
        reported.set()

    worker = LatestWorker(lambda item: 1 / item, crash)
    worker.put(0)
    assert reported.wait(10.0)
    assert isinstance(crashes[0], ZeroDivisionError)
    assert worker.stop(10.0)


def test_gaps_in_sequence_numbers_are_losses():
    losses = LossCounter(known=[b"a"])
    numbers = [(b"a", 7), (b"a", 8), (b"a", 11), (b"a", 12), (b"a", 1), (b"a", 2)]
    assert [losses.lost_before(publisher, n) for publisher, n in numbers] == [0, 0, 2, 0, 0, 0]


def test_first_clouds_of_a_new_publisher_are_missed_too():
    losses = LossCounter(known=[b"known"])
    assert losses.lost_before(b"new", 3) == 2
    assert losses.lost_before(b"new", 5) == 1
    assert losses.lost_before(b"prompt", 1) == 0
    assert losses.lost_before(b"known", 3) == 0
    assert losses.lost_before(b"discovered late", 4711) == 0


def test_counts_from_many_threads():
    counters = FrameCounters()
    threads = [
        threading.Thread(target=lambda: [counters.add(received=1, dropped=1) for _ in range(2000)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (counters.counts.received, counters.counts.dropped) == (8000, 8000)


def test_silence_names_its_cause():
    def say(last, publishers, now=10.0):
        return silence(now, 5.0, last, publishers, 2.0, "/surface_points")

    assert say(9.0, 1) is None
    assert say(None, 0) is None
    assert "FASTDDS_DEFAULT_PROFILES_FILE" in say(None, 1)
    # Also after a first one: of large clouds the first often gets through.
    assert "FASTDDS" in say(7.0, 1) and "got none for 3.0 s" in say(7.0, 1)
    assert "gone" in say(7.0, 0) and "FASTDDS" not in say(7.0, 0)
    assert silence(6.9, 5.0, None, 1, 2.0, "/t") is None


def test_throttle_repeats_a_sentence_only_so_often():
    throttle = Throttle(2.0)
    assert throttle.due("got 1.5 mm", 0.0)
    assert not throttle.due("got 2 mm", 1.9)
    assert throttle.due("something else", 1.9)
    assert throttle.due("got 3e-07 mm", 2.1)


def test_registration_takes_points_from_the_cloud_to_the_organ():
    registration = Registration()
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    inside = np.array([[0.01, 0.02, 0.03], [-0.04, 0.0, 0.1]])
    seen = np.hstack([inside, np.ones((2, 1))]) @ CAMERA_FROM_ORGAN.T
    motion = registration.organ_from_cloud("camera", "organ", 0)
    np.testing.assert_allclose(transform_points(motion, seen[:, :3]), inside, atol=1e-12)
    np.testing.assert_array_equal(registration.organ_from_cloud("organ", "organ", 0), np.eye(4))


def test_newest_registration_counts_and_others_do_not():
    registration = Registration()
    registration.put(registration_message(np.eye(4), parent="camera"))
    registration.put(registration_message(np.eye(4), parent="microscope"))
    with pytest.raises(InvalidInputError, match="'organ' in 'microscope'"):
        registration.organ_from_cloud("camera", "organ", 0)


def test_tf_is_asked_when_no_registration_fits():
    asked = []

    class Tf:
        def lookup(self, cloud_frame, organ_frame, stamp_ns):
            asked.append((cloud_frame, organ_frame, stamp_ns))
            return registration_message(CAMERA_FROM_ORGAN) if cloud_frame == "camera" else None

    registration = Registration(Tf())
    expected = np.linalg.inv(CAMERA_FROM_ORGAN)
    np.testing.assert_allclose(registration.organ_from_cloud("camera", "organ", 42), expected, atol=1e-12)
    with pytest.raises(InvalidInputError, match="'moon'"):
        registration.organ_from_cloud("moon", "organ", 43)
    assert asked == [("camera", "organ", 42), ("moon", "organ", 43)]


def test_parameter_file_has_every_parameter_with_its_default():
    text = (PACKAGE / "config" / "softtissue_estimator.yaml").read_text()
    listed = yaml.safe_load(text)["/**"]["ros__parameters"]
    defaults = dataclasses.asdict(EstimatorConfig()) | parameters.NODE_DEFAULTS
    assert listed == defaults
    # ROS is strict: 1 is not a double.
    assert {n: type(v) for n, v in listed.items()} == {n: type(v) for n, v in defaults.items()}


def test_descriptors_tell_type_unit_and_range():
    for field in dataclasses.fields(EstimatorConfig):
        described = parameters.descriptor(field)
        assert described.name == field.name
        assert field.metadata["description"] in described.description
        assert field.metadata["unit"] in described.description
        if field.metadata["range"] is not None:
            limits = (described.floating_point_range or described.integer_range)[0]
            assert (limits.from_value, limits.to_value) == field.metadata["range"]


def test_live_parameters_change_and_others_only_when_unconfigured():
    config = EstimatorConfig()
    live = [Parameter("frame_budget_s", value=0.5)]
    assert parameters.changed_config(config, live, configured=True).frame_budget_s == 0.5
    device = [Parameter("device", value="cpu")]
    assert parameters.changed_config(config, device, configured=False).device == "cpu"
    with pytest.raises(InvalidInputError, match="device: can only be changed while the node is unconfigured"):
        parameters.changed_config(config, device, configured=True)
    with pytest.raises(InvalidInputError, match="one of auto, cuda, cpu"):
        parameters.changed_config(config, [Parameter("device", value="tpu")], configured=False)
    assert frozenset(f.name for f in dataclasses.fields(EstimatorConfig)) >= parameters.LIVE


@pytest.mark.parametrize(
    ("free_mb", "name"), [(24_000, "fastdds_profile.xml"), (64, "fastdds_profile_small.xml")]
)
def test_profile_fits_the_shared_memory(free_mb, name):
    assert transport.choose_profile(free_mb * 2**20).name == name


def test_users_own_profile_is_left_alone(monkeypatch):
    monkeypatch.setenv(transport.VARIABLE, "/somewhere/else.xml")
    assert "/somewhere/else.xml" in transport.use_profile()


def test_score_counts_and_measures():
    record = scoring.Record(dropped=1, refused=0)
    record.reference = np.zeros((2, 3))
    record.sent_ns = {1: 1_000_000, 2: 2_000_000, 3: 3_000_000, 4: 4_000_000}
    record.answered_ns = {1: 21_000_000, 2: 12_000_000, 4: 34_000_000}
    # Frame 1: nothing has moved. Frame 2: 10 and 20 mm, estimated to 1 and 2 mm. Frame 4: 30 and 40, to 3 and 5.
    record.truth = {
        1: np.zeros((2, 3)),
        2: np.array([[0.01, 0.0, 0.0], [0.0, 0.02, 0.0]]),
        4: np.array([[0.03, 0.0, 0.0], [0.0, 0.0, 0.04]]),
    }
    record.estimate = {
        1: np.zeros((2, 3)),
        2: np.array([[0.009, 0.0, 0.0], [0.0, 0.022, 0.0]]),
        4: np.array([[0.03, 0.003, 0.0], [0.0, 0.0, 0.035]]),
    }
    report = scoring.make_report(record)
    assert report["frames"] == {"sent": 4, "answered": 3, "dropped": 1, "refused": 0, "unaccounted": 0}
    assert report["latency_ms"] == pytest.approx({"p50": 20.0, "p95": 29.0, "max": 30.0})
    errors = report["tre_mm"]
    assert (errors["scored_frames"], errors["displaced_frames"]) == (3, 2)
    assert errors["before"] == pytest.approx({"mean": 25.0, "max": 40.0})
    assert errors["after"] == pytest.approx({"mean": 2.75, "max": 5.0})
    assert errors["peak"]["stamp_ns"] == 4
    assert errors["peak"]["after"] == pytest.approx({"mean": 4.0, "max": 5.0})
    assert errors["markers"][1]["before"] == pytest.approx({"mean": 30.0, "max": 40.0})
    assert scoring.failures(report) == []
    assert "marker 2" in scoring.table(report, "title")


def test_score_complains_about_lost_frames_and_no_improvement():
    record = scoring.Record(reference=np.zeros((1, 3)))
    record.sent_ns, record.answered_ns = {1: 0, 2: 0}, {1: 5}
    record.truth, record.estimate = {1: np.array([[0.01, 0.0, 0.0]])}, {1: np.array([[-0.01, 0.0, 0.0]])}
    problems = scoring.failures(scoring.make_report(record))
    assert len(problems) == 2
    assert "got 1 + 0 + 0" in problems[0]
    assert "less than 10.0 mm, got 20.0 mm" in problems[1]


def test_launch_file_and_rviz_configuration_are_well_formed():
    # Neither launch nor RViz is on PyPI: what can be checked without them is.
    tree = ast.parse((PACKAGE / "launch" / "softtissue.launch.py").read_text())
    assert any(isinstance(n, ast.FunctionDef) and n.name == "generate_launch_description" for n in tree.body)
    names = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    for topic in ("surface_points", "correspondences", "registration"):
        assert topic in names
    assert {f.name for f in dataclasses.fields(EstimatorConfig)} >= {
        "organ",
        "estimator",
        "checkpoint",
        "device",
    }
    displays = yaml.safe_load((PACKAGE / "rviz" / "softtissue.rviz").read_text())["Visualization Manager"]
    assert displays["Global Options"]["Fixed Frame"] == "organ"
    topics = {d["Topic"]["Value"] for d in displays["Displays"] if "Topic" in d}
    assert topics == {
        "/softtissue_estimator/markers",
        "/softtissue_estimator/deformed_points",
        "/surface_points",
    }


class Recorder:
    """Stands in for a class of a package that is not on PyPI: remembers how it was made."""

    def __init__(self, *args, **keywords):
        self.args, self.keywords = args, keywords


def stand_in(monkeypatch, name, **members):
    module = types.ModuleType(name)
    vars(module).update(members)
    monkeypatch.setitem(sys.modules, name, module)
    return module


@pytest.fixture
def launch_file(monkeypatch):
    """The launch file as a module, with stand-ins for launch and launch_ros."""

    class LaunchConfiguration(Recorder):
        def perform(self, context):
            return context[self.args[0]]

    stand_in(monkeypatch, "launch", LaunchContext=dict, LaunchDescription=list)
    actions = {
        n: type(n, (Recorder,), {})
        for n in ("DeclareLaunchArgument", "OpaqueFunction", "SetEnvironmentVariable")
    }
    stand_in(monkeypatch, "launch.actions", **actions)
    stand_in(monkeypatch, "launch.conditions", IfCondition=Recorder)
    stand_in(monkeypatch, "launch.substitutions", LaunchConfiguration=LaunchConfiguration)
    stand_in(monkeypatch, "launch_ros")
    stand_in(monkeypatch, "launch_ros.actions", LifecycleNode=Recorder, Node=Recorder)
    source = PACKAGE / "launch" / "softtissue.launch.py"
    spec = importlib.util.spec_from_file_location("softtissue_launch", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_launch_file_passes_on_what_is_given(launch_file):
    described = launch_file.generate_launch_description()
    declared = {
        a.args[0]: a.keywords["default_value"] for a in described if type(a).__name__.startswith("Declare")
    }
    given = declared | {"organ": "/data/liver", "autostart": "False", "surface_points": "/tracker/points"}
    (node,) = launch_file.estimator(given)
    assert (node.keywords["package"], node.keywords["executable"]) == ("softtissue_estimator", "node")
    file, chosen = node.keywords["parameters"]
    assert Path(file).name == "softtissue_estimator.yaml" and Path(file).is_file()
    assert chosen == {"organ": "/data/liver", "autostart": False}
    assert dict(node.keywords["remappings"]) == {
        "surface_points": "/tracker/points",
        "correspondences": "correspondences",
        "registration": "registration",
    }
    rviz = Path(described[-1].keywords["arguments"][1])
    assert rviz.is_file()


def test_tf_is_asked_at_the_stamp_then_for_the_newest(monkeypatch):
    asked = []

    class ExtrapolationException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target, source, time):
            asked.append((target, source, time.nanoseconds))
            if time.nanoseconds:
                raise ExtrapolationException
            return "newest"

    stand_in(
        monkeypatch, "tf2_ros", Buffer=Buffer, TransformListener=Recorder, LookupException=KeyError,
        ConnectivityException=KeyError, ExtrapolationException=ExtrapolationException,
    )  # fmt: skip
    source = tf_source(None)
    assert source.lookup("camera", "organ", 42) == "newest"
    # lookup_transform(target, source) gives the pose of the source in the target: what `registration` states.
    assert asked == [("camera", "organ", 42), ("camera", "organ", 0)]


def test_without_tf_there_is_no_source(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    assert tf_source(None) is None
