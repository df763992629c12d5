"""Command lines of the executables as a user types them: what is wrong is one sentence and an exit code."""

import os
import re
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import NodeProcess, executable
from softtissue_estimator.support.resources import resource


def run(environment, name, *arguments):
    return subprocess.run(
        [executable(name), *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_node_shows_its_help(environment):
    ended = run(environment, "node", "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--ros-args" in ended.stdout and "maximum_sigma_m" in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["-p", "organ:=/data/liver"], "did you mean --ros-args -p organ:=/data/liver?"),
        (["--ros-args", "-p", "estimater:=paper"], "did you mean estimator?"),
    ],
)
def test_node_refuses_what_it_does_not_know(environment, arguments, hint):
    ended = run(environment, "node", *arguments)
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert "expected" in line and line.endswith(hint)


PLACES = {"report": "tools.report"}
"""Rooms of executables that are not called as they are."""


def without(missing, name, environment, *arguments):
    """Run an executable where a library is not installed."""
    script = (
        "import sys\n"
        f"sys.modules['{missing}'] = None\n"
        f"from softtissue_estimator.ros.{PLACES.get(name, name)}.main import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("program", "library", "parameter", "words"),
    [
        ("overlay", "cv2", "margin_mm", "OpenCV and Numba, got no cv2; pip install"),
        ("viewer", "viser", "maximum_age_s", "viser, got no viser; pip install viser 'rich<15'"),
        ("igtl_bridge", "pyigtl", "maximum_age_s", "pyigtl, got none; pip install pyigtl"),
    ],
)
def test_program_without_its_library_shows_its_help_and_says_what_to_install(
    environment, program, library, parameter, words
):
    ended = without(library, program, environment, "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--ros-args" in ended.stdout and parameter in ended.stdout
    ended = without(library, program, environment, "-p", f"{parameter}:=5.0")
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1].endswith(f"did you mean --ros-args -p {parameter}:=5.0?")
    ended = without(library, program, environment)
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert line.startswith(f"error: {program}: expected {words}")


@pytest.mark.parametrize(
    ("program", "library", "parameter", "words"),
    [
        ("overlay", "cv2", "margin_m:=0.01", r"expected .*did you mean margin_mm\?$"),
        ("viewer", "viser", "prot:=8081", r"expected .*did you mean port\?$"),
        ("viewer", "viser", "port:=99999", "parameter port"),
        (
            "viewer",
            "viser",
            "host:=no.such.host.invalid",
            r"host: expected an address of this machine, got no\.such\.host\.invalid",
        ),
        ("igtl_bridge", "pyigtl", "prt:=1", r"expected .*did you mean port\?$"),
        ("igtl_bridge", "pyigtl", "port:=70000", "parameter port"),
        ("igtl_bridge", "pyigtl", "coordinates:=SPL", "expected one of LPS, RAS"),
        ("igtl_bridge", "pyigtl", "host:=192.0.2.1", "host, port: expected an address of this machine"),
    ],
)
def test_program_refuses_what_it_cannot_use(environment, program, library, parameter, words):
    pytest.importorskip(library, reason=f"the packages of {program} are not installed")
    ended = run(environment, program, "--ros-args", "-p", parameter)
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert line.startswith("error: ") and re.search(words, line)


def test_viewer_that_others_can_reach_says_so(tmp_path, domain):
    pytest.importorskip("viser", reason="the packages of requirements-viewer.txt are not installed")
    parameters = {"host": "0.0.0.0", "port": 0, "buttons": False}
    with NodeProcess(domain, tmp_path, parameters, [executable("viewer")]) as viewer:
        viewer.wait_for_text("got 0.0.0.0: whoever reaches this computer sees the page\n")


def test_replay_without_a_node_ends_with_a_sentence(environment):
    ended = run(environment, "replay", str(resource("bags", "phantom")), "--timeout", "0.5")
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("error: /surface_points: expected 1 subscriber(s), got 0")


def errors(ended):
    """What an executable says on stderr besides its progress."""
    return [line for line in ended.stderr.replace("\r", "\n").splitlines() if line.startswith("error: ")]


@pytest.mark.parametrize("name", ["record", "report"])
def test_record_and_report_show_their_help_and_want_a_place(environment, name):
    ended = run(environment, name, "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--out" in ended.stdout
    ended = run(environment, name, *(["bag"] if name == "report" else []))
    assert ended.returncode == 2 and "required: --out" in ended.stderr


@pytest.mark.parametrize(
    ("bag", "words"),
    [
        ("nowhere", "nowhere: expected a bag folder, .mcap or .db3 file, got nothing there"),
        (str(resource("bags", "phantom")), "expected messages of softtissue_msgs/msg/EstimatorStatus"),
    ],
)
def test_report_refuses_what_is_no_recording_of_the_node(environment, tmp_path, bag, words):
    ended = run(environment, "report", bag, "--out", str(tmp_path))
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    (line,) = errors(ended)
    assert words in line


@pytest.mark.parametrize(("option", "value"), [("--hold", "0"), ("--at", "nan"), ("--at", "soon")])
def test_report_refuses_times_that_are_none(environment, tmp_path, option, value):
    ended = run(environment, "report", "bag", "--out", str(tmp_path), option, value)
    assert ended.returncode == 2 and option in ended.stderr.splitlines()[-1]


@pytest.mark.parametrize("missing", ["jinja2", "matplotlib"])
def test_report_says_what_to_install(environment, tmp_path, missing):
    ended = without(missing, "report", environment, "bag", "--out", str(tmp_path))
    assert ended.returncode == 2
    (line,) = errors(ended)
    assert line.startswith(f"error: report: expected Jinja2 and matplotlib, got no {missing}; pip install")


def test_record_refuses_a_folder_that_exists(environment, tmp_path):
    ended = run(environment, "record", "--out", str(tmp_path))
    assert (ended.returncode, "Traceback" in ended.stderr) == (2, False)
    (line,) = errors(ended)
    assert line.endswith("expected a new folder, got one that exists")
