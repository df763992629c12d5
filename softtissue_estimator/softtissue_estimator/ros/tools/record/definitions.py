"""Definitions of installed message types as a bag holds them, so that it can be read where they are not installed."""

import re
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.bag import installed_hash, message_type
from softtissue_estimator.support.sentences import one_sentence

_NESTED = re.compile(r"\b([a-z]\w*)/(\w+)")
_LINE = 80 * "="


def definition_of(name: str) -> tuple[str, str]:
    """Return the text of a type such as `sensor_msgs/msg/PointCloud2` with all types in it, and its hash (RIHS01).

    Raises
    ------
    InvalidInputError
        If it is not installed, or one of the types in it.
    """
    parts = [_text(name)]
    waiting, seen = nested_types(name), {name}
    while waiting:
        one = waiting.pop(0)
        if one not in seen:
            seen.add(one)
            parts.append(f"MSG: {one.replace('/msg/', '/')}\n{_text(one)}")
            waiting += nested_types(one)
    known = installed_hash(name)
    if known is None:
        raise InvalidInputError(
            f"expected an installed message type with its hash, got {one_sentence(name, 80)}"
        )
    return f"\n{_LINE}\n".join(parts), known


def nested_types(name: str) -> list[str]:
    """Return the types of a message's fields that are messages themselves."""
    fields = message_type(name).get_fields_and_field_types().values()
    return [f"{package}/msg/{kind}" for field in fields for package, kind in _NESTED.findall(field)]


def _text(name: str) -> str:
    package, _, kind = name.partition("/msg/")
    message_type(name)  # a name that may be part of a path
    try:
        return (Path(get_package_share_directory(package)) / "msg" / f"{kind}.msg").read_text(
            encoding="utf-8"
        )
    except (PackageNotFoundError, OSError) as error:
        raise InvalidInputError(
            f"expected an installed message type with its text, got {one_sentence(name, 80)}"
        ) from error
