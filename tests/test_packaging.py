"""What `pip install` puts where: the wheels of both packages, built without a network."""

import re
import shutil
import subprocess
import sys
import zipfile
from email.message import Message
from email.parser import Parser
from fnmatch import fnmatch
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from installed_packages import named, pinned
from test_dependencies import CORE, ROOT, ROS_PACKAGES, TRAINING, imports

PACKAGES = {"softtissue_estimator": CORE, "training": TRAINING}


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """The wheels, opened, by the folders of their packages."""
    folder = tmp_path_factory.mktemp("wheels")
    for package in PACKAGES:
        leftovers = shutil.ignore_patterns("build", "__pycache__", "*.egg-info")
        shutil.copytree(ROOT / package, folder / package, ignore=leftovers)
    command = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder]
    subprocess.run(
        [sys.executable, "-m", "pip", *command, *(folder / package for package in PACKAGES)], check=True
    )
    found = {path.name.partition("-")[0]: zipfile.ZipFile(path) for path in folder.glob("*.whl")}
    return {"softtissue_estimator": found["softtissue_estimator"], "training": found["softtissue_training"]}


def read(wheel: zipfile.ZipFile, ending: str) -> str:
    (name,) = (name for name in wheel.namelist() if name.endswith(ending))
    return wheel.read(name).decode()


def metadata(wheel: zipfile.ZipFile) -> Message:
    return Parser().parsestr(read(wheel, ".dist-info/METADATA"))


@pytest.mark.parametrize("package", PACKAGES)
def test_wheel_holds_every_module_and_the_mark_of_types(wheels, package):
    source = PACKAGES[package]
    modules = {path.relative_to(source.parent).as_posix() for path in source.rglob("*.py")}
    assert modules | {f"{source.name}/py.typed"} <= set(wheels[package].namelist())


@pytest.mark.parametrize("package", PACKAGES)
def test_metadata_say_what_it_is_and_where_it_comes_from(wheels, package):
    said = metadata(wheels[package])
    assert "Apache-2.0" in (said["License-Expression"] or said["License"])
    assert read(wheels[package], "licenses/LICENSE") == (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert said["Requires-Python"] == ">=3.11"
    assert said.get_payload().startswith("# softtissue")
    assert {url.partition(",")[0] for url in said.get_all("Project-URL")} >= {"Homepage", "Documentation"}


def test_estimator_brings_its_resources(wheels):
    start = "/data/share/softtissue_estimator/"
    shared = {name.partition(start)[2] for name in wheels["softtissue_estimator"].namelist()}
    folder = ROOT / "softtissue_estimator"
    for name in ("bags", "config", "launch", "organs", "rviz", "weights"):
        files = {path for path in (folder / name).rglob("*") if path.is_file() and path.suffix != ".pyc"}
        assert len(files) > 0
        assert {path.relative_to(folder).as_posix() for path in files} <= shared


def test_pip_installs_no_command_that_needs_ros(wheels):
    assert read(wheels["softtissue_estimator"], "entry_points.txt").split("\n")[1:-1] == [
        "check_organ = softtissue_estimator.organ.check_organ:main",
        "import_organ = softtissue_estimator.segmentation.import_organ:main",
    ]
    assert read(wheels["training"], "entry_points.txt").split("\n")[1:-1] == [
        "softtissue-train = softtissue_training.__main__:main"
    ]


def test_training_needs_the_estimator(wheels):
    needed = metadata(wheels["training"]).get_all("Requires-Dist")
    (estimator,) = (one for one in needed if one.startswith("softtissue-estimator"))
    # In no index: it is taken from beside the training package.
    assert re.fullmatch(r"softtissue-estimator ?@ file:///\S+/softtissue_estimator", estimator)


def test_ros_knows_the_same_version_and_licence(wheels):
    said = metadata(wheels["softtissue_estimator"])
    manifest = ElementTree.parse(ROOT / "softtissue_estimator" / "package.xml").getroot()
    assert manifest.findtext("version") == said["Version"]
    assert manifest.findtext("license") == said["License"]


def test_every_dependency_has_its_line_of_why(wheels):
    needs = [need for package in PACKAGES for need in metadata(wheels[package]).get_all("Requires-Dist")]
    names = {canonicalize_name(Requirement(need).name) for need in needs}
    names |= {
        canonicalize_name(need.name) for file in ROOT.glob("requirements*.txt") for need in named(file.name)
    }
    page = (ROOT / "docs" / "reference" / "dependencies.md").read_text(encoding="utf-8")
    said = [canonicalize_name(word) for word in re.findall(r"(?<![\w/`])[a-zA-Z][\w*-]+", page)]
    assert {"vtk", "gmsh", "uv", "ros-rclpy", "mkdocs"} <= names
    unsaid = [name for name in names if not any(fnmatch(name, word) for word in said)]
    assert sorted(set(unsaid) - {"softtissue-estimator"}) == []


def declared(package: str, *kinds: str) -> set[str]:
    manifest = ElementTree.parse(ROOT / package / "package.xml").getroot()
    return {one.text for kind in kinds for one in manifest.findall(kind)}


@pytest.mark.parametrize(
    ("package", "kinds"),
    [
        ("softtissue_estimator", {"softtissue_estimator": ("exec_depend",), "launch": ("exec_depend",)}),
        ("softtissue_estimator", {"test": ("exec_depend", "test_depend")}),
        ("softtissue_msgs", {"test": ("depend", "test_depend")}),
    ],
)
def test_manifest_declares_what_is_imported_of_ros(package, kinds):
    for folder, fields in kinds.items():
        sources = [*(ROOT / package / folder).rglob("*.py")]
        used = {name.partition(".")[0] for source in sources for name in imports(source)} & ROS_PACKAGES
        assert sources and used
        assert sorted(used - declared(package, *fields) - {package}) == []


def test_manifest_declares_nothing_of_ros_that_is_not_used():
    sources = [*CORE.rglob("*.py"), *(ROOT / "softtissue_estimator" / "launch").rglob("*.py")]
    used = {name.partition(".")[0] for source in sources for name in imports(source)}
    # Started, not imported.
    started = {"ros2launch", "rviz2"}
    kept = {name for name in declared("softtissue_estimator", "exec_depend") if "python3" not in name}
    assert sorted(kept - used - started) == []


@pytest.mark.parametrize("package", ["softtissue_estimator", "softtissue_msgs"])
def test_manifest_says_whose_it_is_and_where(package):
    manifest = ElementTree.parse(ROOT / package / "package.xml").getroot()
    assert re.fullmatch(r"\S+@\S+\.\S+", manifest.find("maintainer").get("email"))
    assert {url.get("type") for url in manifest.findall("url")} == {"website", "bugtracker", "repository"}
    assert "python3-pytest" in declared(package, "test_depend")


def test_oldest_numpy_and_scipy_that_are_declared_are_those_that_are_tested(wheels):
    tested = pinned("requirements-numpy1.txt")
    stated = [Requirement(need) for need in metadata(wheels["softtissue_estimator"]).get_all("Requires-Dist")]
    for needs in (stated, named("requirements.txt")):
        oldest = {need.name: str(need.specifier).removeprefix(">=") for need in needs if need.name in tested}
        assert {name: tested[name].rpartition(".")[0] for name in tested} == oldest
