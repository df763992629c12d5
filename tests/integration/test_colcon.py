"""`colcon test` in the built workspace: the tests of each package, with what its package.xml declares."""

import re
import subprocess
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix

SOURCES = Path(__file__).parents[2] / "ros2_ws" / "src"
PACKAGES = ("softtissue_estimator", "softtissue_msgs")


@pytest.mark.timeout(240)
def test_each_package_has_tests_and_none_fails(tmp_path, environment):
    workspace = Path(get_package_prefix(PACKAGES[0])).parents[1]

    def colcon(*arguments):
        return subprocess.run(
            ["colcon", "--log-base", tmp_path / "log", *arguments],
            cwd=workspace, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip

    tested = colcon("test", "--base-paths", SOURCES, "--return-code-on-test-failure")
    summed = colcon("test-result", "--all")
    assert (tested.returncode, summed.returncode) == (0, 0), tested.stdout + summed.stdout
    for package in PACKAGES:
        count = re.search(
            rf"build/{package}/\S+: (\d+) tests, 0 errors, 0 failures, 0 skipped", summed.stdout
        )
        assert count and int(count[1]) > 5, summed.stdout
