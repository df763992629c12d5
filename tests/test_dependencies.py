"""Dependencies point one way: training -> core <- ros -> messages, and the core needs no ROS."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORE = ROOT / "softtissue_estimator" / "softtissue_estimator"
TRAINING = ROOT / "training" / "softtissue_training"
BANNED = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["ruff"]["lint"][
    "flake8-tidy-imports"
]["banned-api"]
ROS_PACKAGES = {*BANNED, "rosidl_parser", "tf2_geometry_msgs"}
CORE_MODULES = sorted(path for path in CORE.rglob("*.py") if "ros" not in path.relative_to(CORE).parts)

PACKAGES = {path.parent.name for path in CORE.glob("*/__init__.py")} - {"ros"}
SHARED = {path.stem for path in CORE.glob("*.py")}


def core_imports(paths: list[Path]) -> set[str]:
    """First names, within the core, of all of it that files import."""
    names = {name for path in paths for name in imports(path) if name.startswith("softtissue_estimator.")}
    return {name.split(".")[1] for name in names}


def imports(path: Path) -> set[str]:
    """Dotted names of all that a file imports, also inside functions; relative ones resolved."""
    package = path.relative_to(ROOT).parts[1:-1]  # below the folder of the distribution
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            found.update({origin, *(f"{origin}.{alias.name}" for alias in node.names)})
    return found


def offending(paths: list[Path], packages: set[str]) -> list[str]:
    """Say which file imports which of the packages (dotted names, with all below them)."""
    return [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in paths
        for name in sorted(imports(path))
        if any(name == package or name.startswith(f"{package}.") for package in packages)
    ]


def test_core_imports_neither_ros_nor_training():
    assert len(CORE_MODULES) > 10
    assert offending(CORE_MODULES, ROS_PACKAGES | {"softtissue_estimator.ros", "softtissue_training"}) == []


@pytest.mark.parametrize(
    ("folder", "others"),
    [
        ("mesh_files", {"mesh_files", "errors", "mesh"}),
        ("inference", {"inference", "errors", "stopwatch"}),
        ("elastic", {"elastic", "inference"} | SHARED),
        ("hybrid", {"hybrid", "elastic", "inference"} | SHARED),
    ],
)
def test_packages_of_the_core_import_in_one_direction(folder, others):
    modules = sorted((CORE / folder).glob("*.py"))
    assert len(modules) > 3
    assert core_imports(modules) <= others


def test_only_the_entries_of_packages_are_imported_by_what_is_shared():
    entries = {"mesh_io": "mesh_files", "check_organ": "elastic", "paper_estimator": "inference"}
    found = {path.stem: core_imports([path]) & PACKAGES for path in sorted(CORE.glob("*.py"))}
    assert {name: packages for name, packages in found.items() if packages} == {
        name: {package} for name, package in entries.items()
    }


def test_ros_side_does_not_import_training():
    assert offending(sorted((CORE / "ros").rglob("*.py")), {"softtissue_training"}) == []


def test_training_imports_no_ros():
    modules = sorted(TRAINING.rglob("*.py"))
    assert len(modules) > 5
    assert offending(modules, ROS_PACKAGES | {"softtissue_estimator.ros"}) == []


def test_import_check_sees_what_the_ros_side_imports():
    assert offending(sorted((CORE / "ros").rglob("*.py")), {"rclpy", "softtissue_msgs"}) != []


@pytest.mark.timeout(120)
def test_core_imports_in_an_interpreter_without_ros():
    names = [
        ".".join(path.relative_to(CORE.parent).with_suffix("").parts).removesuffix(".__init__")
        for path in CORE_MODULES
    ]
    script = f"""
import importlib, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(ROS_PACKAGES)!r}:
            raise ModuleNotFoundError(f"{{name}} is not installed here", name=name)

sys.meta_path.insert(0, NoRos())
sys.path.insert(0, {str(CORE.parent)!r})
for name in {names!r}:
    importlib.import_module(name)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_documents_name_files_that_exist():
    named = r"\b(?:tests|training|softtissue_estimator)/[\w/]+\.py\b"
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    found = {name for page in pages for name in re.findall(named, page.read_text(encoding="utf-8"))}
    places = (ROOT, ROOT / "softtissue_estimator")
    assert len(found) > 10
    assert [name for name in sorted(found) if not any((place / name).is_file() for place in places)] == []
