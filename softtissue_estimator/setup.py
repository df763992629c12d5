"""What pyproject.toml cannot say: the files beside the code, and commands for colcon alone."""

import re
import sys
from pathlib import Path
from typing import Any

from setuptools import find_packages, setup

NAME = "softtissue_estimator"
# Folders whose files go to share/softtissue_estimator/ as they are.
SHARED = ("bags", "config", "foxglove", "launch", "organs", "rviz", "weights")
# `ros2 run softtissue_estimator ...` looks these up in lib/softtissue_estimator/, where setup.cfg has colcon put them.
ROS_COMMANDS = {
    "node": "ros.node",
    "replay": "ros.tools.replay",
    "score": "ros.tools.score",
    "record": "ros.tools.record.main",
    "report": "ros.tools.report.main",
    "demo": "ros.tools.demo",
    "latency": "ros.tools.latency.main",
    "overlay": "ros.overlay.main",
    "viewer": "ros.viewer.main",
    "igtl_bridge": "ros.igtl_bridge.main",
}
COMMANDS = {"check_organ": "organ.check_organ", "import_organ": "segmentation.import_organ"}
# pip, which builds a wheel, would put them into bin/, where `node` hides another program and there may be no ROS.
WHEEL_STEPS = {"bdist_wheel", "dist_info", "editable_wheel"}


def shared_files() -> list[tuple[str, list[str]]]:
    """List the files of the shared folders by the folder they are installed into."""
    targets: dict[str, list[str]] = {}
    for folder in SHARED:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                targets.setdefault(f"share/{NAME}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(targets.items())


def commands() -> list[str]:
    """List the entry points of the commands that this kind of installation has."""
    modules = COMMANDS if WHEEL_STEPS & set(sys.argv) else COMMANDS | ROS_COMMANDS
    return [f"{command} = {NAME}.{module}:main" for command, module in modules.items()]


def steps() -> dict[str, Any]:
    """Return what `colcon build --symlink-install` runs instead of setuptools' own, which overlooks [build_scripts]."""
    if "develop" not in sys.argv:
        return {}
    from setuptools.command.develop import develop

    class LinkedInstallation(develop):
        def write_script(self, script_name: str, contents: str, *mode: str) -> None:
            executable = self.get_finalized_command("build_scripts").executable
            super().write_script(script_name, re.sub(r"\A#!.*", f"#!{executable}", contents), *mode)

    return {"develop": LinkedInstallation}


setup(
    cmdclass=steps(),
    license="Apache-2.0",  # in pyproject.toml no form is right for both setuptools 68, which ROS 2 Jazzy has, and 79
    python_requires=">=3.11",  # in pyproject.toml it becomes a value that colcon cannot read
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared_files(),
    ],
    zip_safe=False,
    entry_points={"console_scripts": commands()},
)
