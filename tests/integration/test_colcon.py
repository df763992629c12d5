"""colcon as users call it: the tests of each package, and executables for the Python of a virtual environment."""

import os
import re
import subprocess
import sys
import venv
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


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "linked"])
def test_executables_are_started_with_the_python_of_the_active_environment(tmp_path, options):
    """As after `python3 -m venv --system-site-packages`: colcon itself runs on another Python, that of the system."""
    environment = tmp_path / "environment"
    venv.create(environment, symlinks=True)
    (packages,) = environment.glob("lib/python3*/site-packages")
    of_the_system = "\n".join(folder for folder in sys.path if folder.endswith("site-packages"))
    (packages / "of_the_system.pth").write_text(of_the_system, encoding="utf-8")
    (packages / "says_where.pth").write_text("import sys; print(sys.prefix)", encoding="utf-8")
    active = os.environ | {"PATH": f"{environment}/bin:{os.environ['PATH']}", "VIRTUAL_ENV": str(environment)}
    build = ["colcon", "build", "--base-paths", SOURCES, "--packages-select", PACKAGES[0], *options]
    built = subprocess.run(build, cwd=tmp_path, env=active, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr

    program = tmp_path / "install" / PACKAGES[0] / "lib" / PACKAGES[0] / "check_organ"
    shown = subprocess.run([program, "--help"], env=active, capture_output=True, text=True, check=False)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert shown.stdout.startswith(f"{environment}\n") and "\nusage: " in shown.stdout
