"""Which source files of the estimator a stored result depends on."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable
from pathlib import Path

import softtissue_estimator

_NODE = "ros"


def core_sources() -> list[Path]:
    """List all modules of the estimator's core, in a fixed order; those of its node are not among them."""
    folder = _core_folder()
    return sorted(path for path in folder.rglob("*.py") if path.relative_to(folder).parts[0] != _NODE)


def imported_sources(modules: Iterable[str], without: Collection[str] = ()) -> dict[str, Path]:
    """Follow imports through the core.

    Parameters
    ----------
    modules : iterable of str
        Where to begin, named as within the core, such as "estimators.elastic.estimator".
    without : collection of str
        Modules, or whole packages, that are not followed.

    Returns
    -------
    dict
        Files by their modules' names, in the order of the names.
    """
    folder = _core_folder()
    waiting, found = [*modules], dict[str, Path]()
    while waiting:
        module = waiting.pop()
        if module in found or any(f"{module}.".startswith(f"{name}.") for name in without):
            continue
        found[module] = folder.joinpath(*module.split(".")).with_suffix(".py")
        waiting += _imports(found[module])
    return dict(sorted(found.items()))


def _core_folder() -> Path:
    return Path(softtissue_estimator.__file__).parent


def _imports(source: Path) -> list[str]:
    """Names of the core's modules that a module imports."""
    nodes = ast.walk(ast.parse(source.read_text(encoding="utf-8")))
    modules = [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    package = softtissue_estimator.__name__ + "."
    return [module.removeprefix(package) for module in modules if module.startswith(package)]
