"""The one reader of YAML that users write: plain values of limited size, no aliases, one sentence for every mistake.

What it says of a file that is none of ours tells nothing of its content: anybody may name any file.
"""

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.support.files import read_limited

MOST_BYTES = 2**20
_DEEPEST = 16
_LONGEST_SCALAR = 4096  # characters: numbers to base 60 of more take minutes
_LARGEST_NUMBER = 2**63

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 60


class _Reader(_Loader):  # type: ignore[misc]
    """Refuses a key that is there twice, of which YAML keeps the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem="a key that is there twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path, mistake: type[SoftTissueError]) -> Any:
    """Read a file of one document; None if it is empty.

    Parameters
    ----------
    path : Path
    mistake : type
        Of what is raised.

    Raises
    ------
    SoftTissueError
        If it is no file, cannot be read, or is not such YAML.
    """
    try:
        content = read_limited(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise mistake(f"{path}: expected YAML, got {error}") from error
    try:
        _check_events(content)
        values = yaml.load(content, Loader=_Reader)  # derived from the safe loader
        _check_numbers(values)
    except yaml.MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        # Up to what the file contains.
        problem = (error.problem or "no YAML").partition("'")[0].partition('"')[0].strip()
        raise mistake(f"{path}: expected YAML, got a mistake{line}: {problem}") from error
    except (
        Exception
    ) as error:  # of the reader: no memory for it, no such date, no number of so many digits, ...
        raise mistake(
            f"{path}: expected YAML, got a value that cannot be read ({type(error).__name__})"
        ) from None
    return values


def shown(value: Any) -> str:
    """Return a value of a file that is ours, shortened, for a message."""
    return _short.repr(value)


def kind_of(value: Any) -> str:
    """Return what a value is, in words that tell nothing of it."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "text" if isinstance(value, str) else f"a value of type {type(value).__name__}"


def _check_events(content: bytes) -> None:
    depth = 0
    for event in yaml.parse(content, Loader=_Loader):
        mark: Any = event.start_mark
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(problem="an alias, of which none is taken", problem_mark=mark)
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                raise yaml.MarkedYAMLError(problem=f"more than {_DEEPEST} levels", problem_mark=mark)
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > _LONGEST_SCALAR:
            problem = f"a value of more than {_LONGEST_SCALAR} characters"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def _check_numbers(values: Any) -> None:
    if isinstance(values, Mapping):
        for key, value in values.items():
            _check_numbers(key)
            _check_numbers(value)
    elif isinstance(values, list | tuple | set):
        for value in values:
            _check_numbers(value)
    elif isinstance(values, int) and abs(values) >= _LARGEST_NUMBER:
        raise ValueError("too many digits")
