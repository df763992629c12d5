"""What `import softtissue_estimator` offers, and how little it loads."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import softtissue_estimator

SOURCE = Path(softtissue_estimator.__file__)
IMPORT = """
import sys, time
began = time.perf_counter()
import softtissue_estimator
print(time.perf_counter() - began)
print(*(name for name in sys.modules if "." not in name))
"""


def declared() -> dict[str, str]:
    """Module of each name that type checkers are told of."""
    block = next(
        node
        for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    return {alias.name: node.module for node in block.body for alias in node.names}


def test_import_is_instant_and_loads_no_library():
    environment = {"PYTHONPATH": str(SOURCE.parents[1])}
    runs = [
        subprocess.run(
            [sys.executable, "-c", IMPORT],
            env=environment,
            cwd="/",
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for _ in range(3)
    ]
    assert min(float(seconds) for seconds, _ in runs) < 0.2
    loaded = set(runs[0][1].split())
    assert loaded & {"torch", "numpy", "scipy", "matplotlib", "trimesh", "igl", "yaml"} == set()


def test_public_names_are_those_that_type_checkers_are_told_of():
    assert declared().keys() == set(softtissue_estimator.__all__)
    assert set(softtissue_estimator.__all__) <= set(dir(softtissue_estimator))


@pytest.mark.parametrize("name", softtissue_estimator.__all__)
def test_public_name_is_what_its_module_defines(name):
    assert getattr(softtissue_estimator, name) is getattr(importlib.import_module(declared()[name]), name)


def test_all_kinds_of_error_are_public():
    errors = importlib.import_module("softtissue_estimator.errors")
    kinds = {name for name in vars(errors) if name.endswith("Error")}
    assert kinds <= set(softtissue_estimator.__all__)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'softtissue_estimator' has no attribute 'nothing'"):
        softtissue_estimator.nothing  # noqa: B018
