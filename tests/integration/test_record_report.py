"""A node that answers, a recording of it, and the report of that recording: all as processes of their own."""

import os
import resource
import signal
import subprocess
import time
from html.parser import HTMLParser

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
pytest.importorskip("jinja2", reason="Jinja2 is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.serialization import deserialize_message

from integration.harness import Client, NodeProcess, PlainClient, executable, write_organ
from integration.scene import Scene, nanoseconds
from ros_domain import environment_of
from softtissue_estimator.ros.tools.bag import Bag

S = 1_000_000_000
CLOUDS = 6
NODE = "/softtissue_estimator"


class Tables(HTMLParser):
    """Rows of a page's tables by their names, its pictures and its tags."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.pictures, self.tags = {}, [], set()
        self._row = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.add(tag)
        if tag == "table":
            self._table = self.rows.setdefault(attributes.get("id"), [])
        elif tag == "tr":
            self._table.append([])
        elif tag in ("td", "th"):
            self._table[-1].append("")
            self._row = self._table[-1]
        elif tag == "img":
            self.pictures.append(attributes)

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._row = None

    def handle_data(self, data):
        if self._row is not None:
            self._row[-1] += data


def run(domain, name, *arguments):
    environment = os.environ | environment_of(domain)
    command = [executable(name), *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=90)


def recording(domain, folder, bag, *arguments):
    folder.mkdir()
    return NodeProcess(domain, folder, {}, [executable("record"), "--out", bag, *arguments])


def recorded(bag):
    """Messages of a bag: topics and their bytes."""
    with Bag(bag) as opened:
        return [(connection.topic, data) for connection, _, data in opened.messages()]


@pytest.fixture(scope="module")
def organ(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"), coarse=True)


def played(domain, tmp_path, bag):
    """Play a bag; the answers that are heard, and what the player says."""
    heard = ["--wait-for", f"{NODE}/deformed_points", "--rate", "5"]
    player = NodeProcess(domain, tmp_path / "record", {}, [executable("replay"), bag, *heard])
    with Client(domain) as client, player as replay:
        client.wait(lambda: len(client.answers) == CLOUDS, "replayed answers", 60.0)
        assert replay.wait(60.0) == 0, replay.text
        return client.answers, replay.text


@pytest.mark.timeout(240)
def test_what_a_node_answers_is_recorded_reported_and_replayed(organ, tmp_path, domain):
    scene, bag = Scene(organ), tmp_path / "bag"
    parameters = {"organ": organ, "minimum_visible_fraction": 0.01, "frame_budget_s": 60.0}
    with NodeProcess(domain, tmp_path, parameters) as node, Client(domain) as client:
        client.wait_until_connected()
        # The recorder comes late: what is kept for late comers is recorded all the same.
        with recording(domain, tmp_path / "record", bag) as recorder:
            for topic in ("deformed_points", "deformed_surface", "status", "registration", "structures"):
                recorder.wait_for_text(f"records {NODE}/{topic}\n")
            recorder.wait_for_text("records /surface_points\n")
            client.wait(lambda: client.clouds.get_subscription_count() == 2, "recorder", 20.0)
            client.spin(0.3)
            stamps = [(100 + number) * S for number in range(CLOUDS)]
            for stamp in stamps:
                client.clouds.publish(scene.cloud(stamp))
                client.answer_of(stamp)
                client.status_of(stamp)
            client.clouds.publish(scene.cloud(200 * S, frame="elsewhere"))
            client.wait(lambda: client.statuses[-1].frames_refused == 1, "refused cloud")
            client.spin(0.5)
            assert recorder.stop() == 0, recorder.text
            assert "Traceback" not in recorder.text
        answers = [bytes(answer.data) for answer in client.answers]
        assert node.stop() == 0, node.text

    topics = [topic for topic, _ in recorded(bag)]
    assert topics.count("/surface_points") == CLOUDS + 1 and topics.count(f"{NODE}/structures") == 1
    assert topics.count(f"{NODE}/deformed_points") == topics.count(f"{NODE}/deformed_surface") == CLOUDS

    ended = run(domain, "report", bag, "--out", tmp_path / "out")
    assert ended.returncode == 0, ended.stderr
    assert (
        ended.stdout == f"{tmp_path / 'out' / 'report.html'}\n" and "report, statuses: 100%" in ended.stderr
    )
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    page = Tables(text)
    assert page.rows["frames"][1] == [str(CLOUDS + 1), str(CLOUDS), "0", "1", "0", "0"]
    assert ["organ", "Test organ"] in page.rows["about"] and ["node", NODE] in page.rows["about"]
    refused = [row for row in page.rows["causes"] if "got frame 'elsewhere'" in row[1]]
    assert [(row[0], row[2]) for row in refused] == [("INVALID", "1")]
    told = {row[0]: row for row in page.rows[None]}
    assert told["all"][1] == told["tumour"][1] == told["visible share"][1] == str(CLOUDS)
    assert float(told["all"][2]) > 0.0 and float(told["tumour"][4]) > 0.0
    pictures = [picture for picture in page.pictures if picture["alt"].startswith("Organ at")]
    assert 2 <= len(pictures) <= 3 and "No picture" not in text
    assert "script" not in page.tags and "://" not in text

    # The recording plays like any other one.
    replayed, _ = played(domain, tmp_path, bag)
    assert [bytes(answer.data) for answer in replayed] == answers
    assert [nanoseconds(answer.header.stamp) for answer in replayed] == stamps


def publishing(domain):
    """A program that publishes a reliable and kept text, then another one best effort."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from std_msgs.msg import String

    client = PlainClient(domain)
    kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    loose = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    return client, String, kept, loose


def test_publisher_that_offers_less_than_the_first_is_recorded_too(tmp_path, domain):
    client, kind, kept, loose = publishing(domain)
    with client, recording(domain, tmp_path / "record", tmp_path / "bag", "--topics", "/words") as recorder:
        client.node.create_publisher(kind, "/words", kept).publish(kind(data="kept"))
        recorder.wait_for_text("records /words\n")
        client.spin(1.0)
        quiet = PublisherEventCallbacks(use_default_callbacks=False)  # that it offers too little at first
        second = client.node.create_publisher(kind, "/words", loose, event_callbacks=quiet)
        client.wait(lambda: second.get_subscription_count() == 1, "recorder", 20.0)
        client.spin(0.5)
        second.publish(kind(data="loose"))
        client.spin(1.0)
        assert recorder.stop(signal.SIGTERM) == 0, recorder.text
    said = [deserialize_message(data, kind).data for _, data in recorded(tmp_path / "bag")]
    assert said == ["kept", "loose"]


def test_recording_of_nothing_is_a_sentence_and_leaves_nothing(tmp_path, domain):
    with recording(domain, tmp_path / "record", tmp_path / "bag", "--topics", "/words") as recorder:
        recorder.wait_for_text("record: 0 messages")
        time.sleep(1.0)
        assert recorder.stop() == 2
    assert "error: record: expected messages on /words, heard none\n" in recorder.text
    assert not (tmp_path / "bag").exists()


def test_disk_that_takes_no_more_ends_the_recording_with_a_sentence(tmp_path, domain):
    client, kind, kept, _ = publishing(domain)

    def limit():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    command = [executable("record"), "--out", tmp_path / "bag", "--topics", "/words"]
    environment = os.environ | environment_of(domain) | {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    with client:
        publisher = client.node.create_publisher(kind, "/words", kept)
        with subprocess.Popen(
            [str(part) for part in command],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=limit,
        ) as recorder:
            client.wait(lambda: publisher.get_subscription_count() == 1, "recorder", 30.0)
            while recorder.poll() is None:
                publisher.publish(kind(data=os.urandom(50_000).hex()))
                client.spin(0.02)
            said = recorder.stderr.read()
    assert recorder.returncode == 2 and "Traceback" not in said, said
    assert "expected a disk that can be written, got: File too large" in said.splitlines()[-1]


@pytest.mark.timeout(240)
def test_recording_whose_process_is_killed_is_reported_and_replayed(organ, tmp_path, domain):
    scene, bag = Scene(organ), tmp_path / "bag"
    parameters = {"organ": organ, "minimum_visible_fraction": 0.01, "frame_budget_s": 60.0}
    stamps = [(100 + number) * S for number in range(CLOUDS)]
    with (
        NodeProcess(domain, tmp_path, parameters),
        Client(domain) as client,
        recording(domain, tmp_path / "record", bag) as recorder,
    ):
        client.wait_until_connected()
        for topic in (f"{NODE}/deformed_points", f"{NODE}/status", "/surface_points"):
            recorder.wait_for_text(f"records {topic}\n")
        client.wait(lambda: client.clouds.get_subscription_count() == 2, "recorder", 20.0)
        client.spin(0.3)
        for stamp in stamps:
            client.clouds.publish(scene.cloud(stamp))
            client.status_of(stamp)
        client.spin(2.0)  # what came longer ago than a second is kept
        recorder.process.kill()
        recorder.process.wait(10.0)
    assert not (bag / "metadata.yaml").exists()
    before = {path: path.read_bytes() for path in bag.iterdir()}

    with Bag(bag) as opened:
        assert opened.cut_off
    topics = [topic for topic, _ in recorded(bag)]
    assert topics.count("/surface_points") == topics.count(f"{NODE}/deformed_points") == CLOUDS
    ended = run(domain, "report", bag, "--out", tmp_path / "out")
    assert ended.returncode == 0, ended.stderr
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert Tables(text).rows["frames"][1] == [str(CLOUDS), str(CLOUDS), "0", "0", "0", "0"]
    assert "expected a recording that ended in order, got one that was cut off" in text

    replayed, said = played(domain, tmp_path, bag)
    assert "cut off" in said
    assert [nanoseconds(answer.header.stamp) for answer in replayed] == stamps
    assert {path: path.read_bytes() for path in bag.iterdir()} == before
