"""What `colcon build` has installed: executables that run, and the files that they need. Run by `colcon test`."""

import os
import subprocess
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

PACKAGE = "softtissue_estimator"
FILES = (
    "bags/phantom/metadata.yaml",
    "config/fastdds_profile.xml",
    "config/softtissue_estimator.yaml",
    "config/softtissue_igtl_bridge.yaml",
    "config/softtissue_overlay.yaml",
    "config/softtissue_viewer.yaml",
    "launch/softtissue.launch.py",
    "organs/phantom_liver/organ.yaml",
    "package.xml",
    "rviz/softtissue.rviz",
    "weights/paper.safetensors",
)


def executables():
    return Path(get_package_prefix(PACKAGE)) / "lib" / PACKAGE


def test_executables_are_where_ros2_run_looks():
    found = {path.name for path in executables().iterdir() if os.access(path, os.X_OK)}
    assert {
        "check_organ",
        "demo",
        "igtl_bridge",
        "import_organ",
        "latency",
        "node",
        "overlay",
        "record",
        "replay",
        "report",
        "score",
        "viewer",
    } <= found


@pytest.mark.parametrize("name", ["check_organ", "igtl_bridge", "import_organ", "node", "overlay", "viewer"])
def test_executable_runs_with_the_packages_of_its_interpreter(name):
    result = subprocess.run([executables() / name, "--help"], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith("usage: ")


@pytest.mark.parametrize("name", FILES)
def test_file_is_in_the_share_folder(name):
    assert (Path(get_package_share_directory(PACKAGE)) / name).stat().st_size > 0
