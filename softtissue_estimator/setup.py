"""Packaging of softtissue_estimator for colcon (ament_python) and pip."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "softtissue_estimator"
# Folders whose files go to share/softtissue_estimator/ as they are.
SHARED = ("bags", "config", "launch", "organs", "rviz", "weights")


def shared_files() -> list[tuple[str, list[str]]]:
    """List the files of the shared folders by the folder they are installed into."""
    targets: dict[str, list[str]] = {}
    for folder in SHARED:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                targets.setdefault(f"share/{NAME}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(targets.items())


setup(
    name=NAME,
    version="0.1.0",
    description="Where an organ's inner structures are, from a part of its surface; a ROS 2 node and its core",
    maintainer="Soft-tissue navigation maintainers",
    maintainer_email="maintainers@softtissue.example.org",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared_files(),
    ],
    install_requires=[
        "libigl",
        "numpy",
        "pytetwild",
        "pyyaml",
        "rosbags",
        "safetensors",
        "scipy",
        "threadpoolctl",
        "torch",
        "tqdm",
        "trimesh",
    ],
    extras_require={
        "vtk": ["vtk"],
        "msh": ["meshio"],
        "demo": ["matplotlib"],
        "dev": [
            "hypothesis",
            "matplotlib",
            "mypy",
            "pytest",
            "pytest-timeout",
            "ruff",
            "scipy-stubs",
            "tqdm",
            "types-PyYAML",
            "types-tqdm",
        ],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"node = {NAME}.ros.node:main",
            f"replay = {NAME}.ros.tools.replay:main",
            f"score = {NAME}.ros.tools.score:main",
            f"demo = {NAME}.ros.tools.demo:main",
            f"latency = {NAME}.ros.tools.latency.main:main",
            f"check_organ = {NAME}.organ.check_organ:main",
        ],
    },
)
