"""Dependencies point one way: training -> core <- ros -> messages, and the core needs no ROS."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import softtissue_estimator

ROOT = Path(__file__).parents[1]
CORE = ROOT / "softtissue_estimator" / "softtissue_estimator"
TRAINING = ROOT / "training" / "softtissue_training"
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
FLOORS = [set(rooms) for rooms in SETTINGS["softtissue"]["floors"]]
ROOMS = set().union(*FLOORS)
ROS_PACKAGES = {
    *SETTINGS["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"],
    "rosidl_parser",
    "tf2_geometry_msgs",
}
MODULES = {
    ".".join(path.relative_to(CORE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(CORE.rglob("*.py"))
    if path != CORE / "__init__.py"
}
CORE_MODULES = [
    CORE / "__init__.py",
    *(path for name, path in MODULES.items() if name.partition(".")[0] != "ros"),
]


def room_of(module: str) -> str:
    """Room, of the table in pyproject.toml, in which a module of the package lies; the smallest one."""
    return max((room for room in ROOMS if f"{module}.".startswith(f"{room}.")), key=len, default="no room")


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


@pytest.mark.parametrize("module", sorted(MODULES))
def test_rooms_import_only_from_floors_below(module):
    room = room_of(module)
    number = next(number for number, rooms in enumerate(FLOORS) if room in rooms)
    allowed = {room}.union(*FLOORS[:number])
    prefix = f"{CORE.name}."
    imported = {name.removeprefix(prefix) for name in imports(MODULES[module]) if name.startswith(prefix)}
    assert {name: room_of(name) for name in imported if room_of(name) not in allowed} == {}


def test_modules_import_one_another_and_not_the_public_names():
    """Whoever follows imports, as stored results do to know what they depend on, must see the module."""
    public = {f"{CORE.name}.{name}" for name in softtissue_estimator.__all__}
    assert len(public) > 10
    assert offending([*MODULES.values(), *sorted(TRAINING.rglob("*.py"))], public) == []


def test_every_room_exists_and_the_root_holds_nothing_else():
    entries = {path.name for path in CORE.iterdir()} - {"__pycache__", "py.typed"}
    assert {path for path in entries if path.endswith(".py")} == {"__init__.py", "config.py", "errors.py"}
    assert entries == {"__init__.py", "config.py", "errors.py"} | {
        room.partition(".")[0] for room in ROOMS - {"config", "errors"}
    }
    assert {room for room in ROOMS if room not in MODULES} == set()


def test_no_module_is_long():
    sources = [*CORE.rglob("*.py"), *TRAINING.rglob("*.py")]
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in sources}
    assert {str(path.relative_to(ROOT)): number for path, number in lines.items() if number > 300} == {}


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
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = {name for page in pages for name in re.findall(named, page.read_text(encoding="utf-8"))}
    places = (ROOT, ROOT / "softtissue_estimator")
    assert len(found) >= 10
    assert [name for name in sorted(found) if not any((place / name).is_file() for place in places)] == []
