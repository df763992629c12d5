"""A node's command line: what it shows, and what it refuses with a hint."""

import argparse
import dataclasses
import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError

_OURS = "expected only --help, and ROS's own arguments behind --ros-args"
# Parameters of rclpy itself; those of quality of service are checked beside the topics.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_OF_TOPICS = "qos_overrides."
_ALIKE = 0.7  # of difflib: one or two letters off in a short name


@dataclass(frozen=True)
class Program:
    """An executable with a node whose parameters are the fields of a dataclass of settings."""

    name: str
    description: str
    example: str
    settings: Any


NODE = Program(
    "node",
    "Publish where the inside of an organ is now, from tracked points of its surface.",
    "ros2 run softtissue_estimator node --ros-args -p organ:=/data/my_liver -r surface_points:=/tracker/points",
    EstimatorConfig,
)


def parse_arguments(command_line: Sequence[str], program: Program = NODE) -> None:
    """Look at the command line without the program's name; `--help` prints and ends the program.

    Raises
    ------
    InvalidInputError
        If there is anything else.
    """
    parser = argparse.ArgumentParser(
        prog=program.name,
        usage=f"{program.name} [--help] [--ros-args -p PARAMETER:=VALUE --params-file FILE -r TOPIC:=TOPIC ...]",
        description=program.description,
        epilog=_parameters(program),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    _, unknown = parser.parse_known_args(outside_ros(command_line))
    if unknown:
        raise InvalidInputError(f"arguments: {_OURS}, got {' '.join(unknown)}{_hint(unknown, program)}")


def check_parameters(
    given: Iterable[str], on_command_line: Sequence[str], program: Program = NODE
) -> list[str]:
    """Look for parameters that were given and that the node does not have.

    A file may hold parameters of other nodes under `/**`. So one that resembles none of the node's and stands in a file
    is not an error.

    Parameters
    ----------
    given : iterable of str
        Names of all that were given, in files or not.
    on_command_line : sequence of str
        The command line with ROS's own arguments.
    program : Program

    Returns
    -------
    list of str
        A sentence for each that is left.

    Raises
    ------
    InvalidInputError
        If a name is misspelt, or one that the command line gives is not known.
    """
    known = [field.name for field in dataclasses.fields(program.settings)]
    direct = given_directly(on_command_line)
    left = []
    for name in sorted(given):
        if name in known or name in _OF_ROS or name.startswith(_OF_TOPICS):
            continue
        alike = difflib.get_close_matches(name, known, 1, _ALIKE)
        said = f"parameter {name}: expected one that the node has"
        if alike:
            raise InvalidInputError(f"{said}, got another; did you mean {alike[0]}?")
        if name in direct:
            raise InvalidInputError(f"{said}, got another; `{program.name} --help` lists them")
        left.append(f"{said}, got another, which is left out")
    return left


def given_directly(command_line: Sequence[str]) -> set[str]:
    """Return the names of the parameters that a command line gives, without those of its files."""
    return {word.partition(":=")[0].rpartition(":")[2] for word in command_line if ":=" in word}


def outside_ros(command_line: Sequence[str]) -> list[str]:
    """Return the words of a command line that are not between `--ros-args` and `--`.

    rclpy's `remove_ros_args` also takes away `NAME:=VALUE` alone, a remapping as ROS 1 wrote it: whoever forgets
    `--ros-args` before a parameter would hear nothing, and no option could have such a value.
    """
    outside, inside = [], False
    for word in command_line:
        if word == "--ros-args":
            inside = True
        elif inside and word == "--":
            inside = False
        elif not inside:
            outside.append(word)
    return outside


def _hint(unknown: Sequence[str], program: Program) -> str:
    known = {field.name for field in dataclasses.fields(program.settings)}
    rules = [word for word in unknown if ":=" in word]
    if not rules:
        return f"; `{program.name} --help` shows how"
    meant = [f"-{'p' if word.partition(':=')[0] in known else 'r'} {word}" for word in rules]
    return f"; did you mean --ros-args {' '.join(meant)}?"


def _parameters(program: Program) -> str:
    lines = [
        f"example: {program.example}",
        "",
        "parameters (with defaults; `ros2 param describe` says more):",
    ]
    for field in dataclasses.fields(program.settings):
        sentence = str(field.metadata["description"]).partition(". ")[0].rstrip(".")
        lines.append(f"  {field.name} ({_shown(field.default)})\n      {sentence}.")
    lines += [
        "",
        "ends with 0 after SIGINT or SIGTERM, with 2 and one sentence where something cannot be used",
    ]
    return "\n".join(lines).replace("%", "%%")


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value) if isinstance(value, tuple) else value)
