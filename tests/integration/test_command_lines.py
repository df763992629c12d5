"""Command lines of the executables as a user types them: what is wrong is one sentence and an exit code."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import executable
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


def without(library, program, environment, *arguments):
    """Run a program where a library is not installed."""
    script = (
        "import sys\n"
        f"sys.modules[{library!r}] = None\n"
        f"from softtissue_estimator.ros.{program}.main import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=60)


def overlay_without_opencv(environment, *arguments):
    return without("cv2", "overlay", environment, *arguments)


def test_bridge_without_pyigtl_shows_its_help_and_says_what_to_install(environment):
    ended = without("pyigtl", "igtl_bridge", environment, "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--ros-args" in ended.stdout and "maximum_age_s" in ended.stdout
    ended = without("pyigtl", "igtl_bridge", environment)
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert line.startswith("error: igtl_bridge: expected pyigtl, got none; pip install pyigtl")


def test_overlay_shows_its_help_and_refuses_arguments_before_it_needs_opencv(environment):
    ended = overlay_without_opencv(environment, "--help")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "--ros-args" in ended.stdout and "margin_mm" in ended.stdout
    ended = overlay_without_opencv(environment, "-p", "margin_mm:=5.0")
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1].endswith("did you mean --ros-args -p margin_mm:=5.0?")


def test_overlay_without_opencv_says_what_to_install(environment):
    ended = overlay_without_opencv(environment)
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert line.startswith("error: overlay: expected OpenCV and Numba, got no cv2; pip install")


def test_overlay_refuses_a_parameter_that_it_does_not_know(environment):
    ended = run(environment, "overlay", "--ros-args", "-p", "margin_m:=0.01")
    assert ended.returncode == 2
    (line,) = (line for line in ended.stderr.splitlines() if "[INFO]" not in line)
    assert "expected" in line and line.endswith("did you mean margin_mm?")


def test_replay_without_a_node_ends_with_a_sentence(environment):
    ended = run(environment, "replay", str(resource("bags", "phantom")), "--timeout", "0.5")
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("error: /surface_points: expected 1 subscriber(s), got 0")
