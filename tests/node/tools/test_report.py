"""The report of bags: what is read of them, and what is said of those that cannot be used."""

import argparse
import contextlib
import re

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
pytest.importorskip("jinja2", reason="Jinja2 is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from rosbags.rosbag2 import StoragePlugin
from softtissue_msgs.msg import EstimatorStatus

from node.tools.answered_bag import ANSWERS, LEAST_SURE, NODE, PERIOD, START, messages, status, write
from node.tools.old_recording import write_old_recording
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.report.moments import choose
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.ros.tools.report.main import parse, run
from softtissue_estimator.ros.tools.report.pictures import draw_moments
from softtissue_estimator.ros.tools.report.reading import Damage, node_of, read_recording
from softtissue_estimator.ros.tools.report.statuses import read_status

STATUS = "softtissue_msgs/msg/EstimatorStatus"


class NotStopped:
    """A request to stop that never comes."""

    event = argparse.Namespace(is_set=lambda: False)


def unwatched(told, _count, _what):
    return told


def read(path, wanted=""):
    with Bag(path) as bag:
        return read_recording(bag, path.name, node_of(bag, path, wanted), unwatched)


def drawn(path, *arguments):
    with Bag(path) as bag:
        moments = choose(read_recording(bag, path.name, NODE, unwatched), *arguments)
        return draw_moments(bag, NODE, "/surface_points", moments, unwatched, Damage())


def reported(tmp_path, path, *arguments):
    assert run(parse([str(path), "--out", str(tmp_path / "out"), *arguments]), NotStopped()) == 0
    return (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_all_that_the_node_said_is_read(tmp_path, plugin):
    told = read(write(tmp_path / "bag", messages(), plugin))
    assert (told.node, told.start_ns, told.damaged, told.broken) == (NODE, START, {}, "")
    assert (len(told.statuses), len(told.answers), told.poses) == (ANSWERS, ANSWERS, ANSWERS)
    third = told.statuses[3]
    assert third.time_s == pytest.approx(0.3, abs=1e-6) and third.stamp_ns == START + 3 * PERIOD
    assert (third.level, third.received, third.about[0]) == ("OK", 4, "liver")
    assert third.stages == (("wait", pytest.approx(0.001)), ("estimate", pytest.approx(0.02)))
    assert third.sigmas == (("a", pytest.approx(0.002)), ("b", pytest.approx(0.001)))
    assert third.visible_fraction == 0.25
    assert told.answers[3].stamp_ns == third.stamp_ns


def test_fields_of_a_status_are_not_mixed_up():
    message = status(
        0, registration_translation_error=1.0, registration_rotation_error=2.0, outlier_fraction=0.5
    )
    message.registration_translation_sigma, message.registration_rotation_sigma = 3.0, 4.0
    message.frames_dropped, message.frames_refused = 6, 7
    message.estimator, message.device, message.matching, message.registration = "e", "d", "m", "r"
    told = read_status(message, 2.5)
    assert (told.pose_error, told.pose_sigma, told.outlier_fraction) == ((1.0, 2.0), (3.0, 4.0), 0.5)
    assert (told.dropped, told.refused, told.time_s) == (6, 7, 2.5)
    assert told.about == ("liver", "e", "d", "m", "r")


def test_first_last_and_least_sure_answer_have_pictures(tmp_path):
    pictures = drawn(write(tmp_path / "bag", messages()))
    assert [p.why for p in pictures] == ["first answer", "largest standard deviation", "last answer"]
    assert pictures[1].time_s == pytest.approx(0.1 * LEAST_SURE, abs=1e-6)
    assert [p.problem for p in pictures] == [""] * 3
    # The same organ in the same place.
    assert pictures[0].png.startswith(b"\x89PNG") and pictures[0].png == pictures[2].png


def without(*names):
    return [one for one in messages() if one[0] not in names]


def test_observed_points_are_drawn_where_their_cloud_and_pose_are_recorded(tmp_path):
    (whole,) = drawn(write(tmp_path / "whole", messages()), [0.3])
    bags = [("/surface_points",), ("registration",), ("/surface_points", "registration")]
    others = [drawn(write(tmp_path / f"bag{n}", without(*names)), [0.3])[0] for n, names in enumerate(bags)]
    assert {other.png for other in others} == {others[0].png} and others[0].png != whole.png


def test_answers_have_a_picture_without_their_surface_and_with_structures_that_come_later(tmp_path):
    told = without("deformed_surface", "structures")
    late = ("structures", "softtissue_msgs/msg/Structures", START + 5 * PERIOD + 9, messages()[0][3])
    (picture,) = drawn(write(tmp_path / "bag", [*told[:25], late, *told[25:]]), [0.1])
    assert picture.png and picture.problem == ""


def test_answers_without_structures_have_a_sentence_instead_of_a_picture(tmp_path):
    pictures = drawn(write(tmp_path / "bag", without("structures")))
    assert {(p.png, p.problem) for p in pictures} == {
        (b"", f"No picture: expected messages on {NODE}/structures, got none that can be read.")
    }


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"\0\1\0\0",
        b"\0\1\0\0" + 40 * b"\xff",
        lambda: status(0, level=77),
        lambda: status(0, stage_names=["wait"]),
        lambda: status(0, structure_sigmas=[]),
    ],
)
def test_damaged_statuses_are_counted(tmp_path, damaged):
    message = damaged() if callable(damaged) else damaged
    told = [*messages(), ("status", STATUS, START + ANSWERS * PERIOD, message)]
    path = write(tmp_path / "bag", told)
    assert read(path).damaged == {f"{NODE}/status": 1}
    assert f"1 damaged message on {NODE}/status left out." in reported(tmp_path, path)


@pytest.mark.parametrize(
    "name", ["deformed_points", "deformed_surface", "structures", "registration", "/surface_points"]
)
def test_other_damaged_messages_end_nothing(tmp_path, name):
    for number, damage in enumerate((b"", b"\0\1\0\0" + 40 * b"\xff", b"\0\1\0\0" + 8 * b"\0" + b"\x7f" * 9)):
        told = [(t, k, at, damage if t == name else message) for t, k, at, message in messages()]
        page = reported(tmp_path, write(tmp_path / f"bag{number}", told))
        assert "<h2>Pictures</h2>" in page
        assert number > 0 or re.search(rf"\d+ damaged messages? on \S*{name} left out", page)


def test_bag_that_is_damaged_inside_is_reported_as_far_as_it_goes(tmp_path, monkeypatch):
    path, whole = write(tmp_path / "bag", messages()), Bag.messages

    def until_the_damage(bag, connections=()):
        for connection, recorded_ns, data in whole(bag, connections):
            if recorded_ns > START + 4 * PERIOD + 5:
                raise InvalidInputError("bag x: expected MCAP that can be read, got noise")
            yield connection, recorded_ns, data

    monkeypatch.setattr(Bag, "messages", until_the_damage)
    told = read(path)
    assert (len(told.statuses), told.duration_s) == (5, pytest.approx(0.4, abs=1e-6))
    assert "got noise" in reported(tmp_path, path)


def test_noise_in_a_bag_has_a_report_or_a_sentence(tmp_path):
    (file,) = write(tmp_path / "bag", messages()).glob("*.mcap")
    data, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(20):
        noisy, begin = bytearray(data), int(rng.integers(len(data) - 16))
        noisy[begin : begin + 16] = rng.bytes(16)
        file.write_bytes(noisy)
        with contextlib.suppress(InvalidInputError):
            read(file)


def test_several_nodes_must_be_told_apart(tmp_path):
    other = [("/second/status", STATUS, START, status(0)), ("/second/status", STATUS, START + 1, status(1))]
    path = write(tmp_path / "bag", [*messages(), *other])
    with pytest.raises(InvalidInputError, match="got /second, /softtissue_estimator; choose one with --node"):
        read(path)
    assert len(read(path, "second").statuses) == 2
    with pytest.raises(InvalidInputError, match="of node third"):
        read(path, "third")


def test_bag_without_a_status_is_a_sentence(tmp_path):
    with pytest.raises(
        InvalidInputError, match=re.escape(f"expected messages of {STATUS} (topic ~/status), got none")
    ):
        read(write(tmp_path / "bag", without("status")))


def test_bag_in_which_no_status_can_be_read_is_a_sentence(tmp_path):
    path = write(tmp_path / "bag", [*without("status"), ("status", STATUS, START + PERIOD, b"\0")])
    with pytest.raises(InvalidInputError, match="/status, got 1 damaged ones"):
        read(path)


def test_status_of_another_definition_is_a_sentence(tmp_path):
    write_old_recording(tmp_path / "bag")
    with pytest.raises(InvalidInputError, match="as it is installed, got some of another definition"):
        read(tmp_path / "bag")


def test_page_is_written_whole_and_replaces_the_one_before(tmp_path):
    path = write(tmp_path / "bag", messages())
    first = reported(tmp_path, path)
    assert reported(tmp_path, path, "--at", "0.3") != first
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["report.html"]
    assert first.count("<figure>") == 3 and "Recording bag" in first


def test_folder_that_cannot_be_written_is_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="^--out .*: expected a folder to write to, got"):
        run(parse([str(write(tmp_path / "bag", messages())), "--out", str(tmp_path / "file")]), NotStopped())


def test_interrupted_report_leaves_nothing(tmp_path, capsys):
    class Stopped:
        event = argparse.Namespace(is_set=lambda: True)

    path = write(tmp_path / "bag", messages())
    assert run(parse([str(path), "--out", str(tmp_path / "out")]), Stopped()) == 1
    assert "error: report: interrupted, nothing was written" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []


def test_levels_are_those_of_the_message():
    levels = (EstimatorStatus.OK, EstimatorStatus.DEGRADED, EstimatorStatus.INVALID)
    assert [read_status(status(0, level=one), 0.0).level for one in levels] == ["OK", "DEGRADED", "INVALID"]
