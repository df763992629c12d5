"""Damaged messages and requests, put into the callbacks of a whole node in this process."""

import random
from pathlib import Path

from fuzz.kind import Kind, MissingError

try:
    from fuzz.message_damage import damaged_message, deserialised, good_message, serialised
    from fuzz.node_inside import NodeInside
except ImportError as error:
    MISSING = str(error)
else:
    MISSING = ""

_KINDS = (
    ("cloud",) * 8
    + ("pair", "bare") * 4
    + ("normals",) * 2
    + ("registration", "registration_with_covariance", "camera_pose", "warp_points", "distance", "parameters")
    * 2
    + ("tool",) * 2
    + ("load_organ", "reset", "register", "decide_registration")
)


class Messages(Kind):
    """Clouds, correspondences, registrations, a tool's poses, calls of services and parameters."""

    name = "messages"
    share = 8

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        if MISSING:
            raise MissingError(MISSING)
        self._node = NodeInside(folder)
        self._scene = self._node.scene

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        kind = rng.choice(_KINDS)
        return f"{kind}.cdr", packed(serialised(rng, damaged_message(rng, kind, self._scene)))

    def run(self, name: str, content: bytes) -> str:
        kind = name.removesuffix(".cdr")
        types = [type(message) for message in good_message(kind, self._scene)]
        messages = deserialised(unpacked(content), types)
        return "no message" if messages is None else self._node.take(kind, messages)

    def check_good(self) -> None:
        self._node.check_good()

    def close(self) -> None:
        self._node.close()


def packed(parts: list[bytes]) -> bytes:
    """Put byte strings one behind another."""
    return b"".join(len(part).to_bytes(4, "little") + part for part in parts)


def unpacked(content: bytes) -> list[bytes]:
    """Undo `packed`."""
    parts, at = [], 0
    while at < len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        parts.append(content[at + 4 : at + 4 + length])
        at += 4 + length
    return parts
