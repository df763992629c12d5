"""A whole node in this process, whose callbacks get damaged messages."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fuzz.damage import how_often
from fuzz.kind import FailedError, Kind, check_sentence, expect

try:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from fuzz.message_damage import deserialised, serialised
    from integration.harness import write_organ
    from softtissue_estimator.organ.organ import load_organ
except ImportError as error:
    MISSING = str(error)
else:
    MISSING = ""


class WholeNode(Kind):
    """Messages for a node that keeps what it says in `said`; of one in ROS's own name alone.

    Parameters
    ----------
    folder : Path
    make_node : callable
        Takes what to call when the node wants to end.
    arguments : list of str
        Further ones of ROS.

    Attributes
    ----------
    kinds : tuple of str
        Of messages, as often as they are wanted.
    """

    kinds: tuple[str, ...] = ()

    def __init__(self, folder: Path, make_node: Callable[[Any], Any], arguments: list[str]) -> None:
        super().__init__(folder)
        self._organ = load_organ(write_organ(folder / "organ"))
        self._fatal: list[BaseException] = []
        rclpy.init(
            args=["--ros-args", "--log-level", "fatal", *arguments],
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._node = make_node(self._fatal.append)

    def good(self, kind: str) -> Any:
        """Return a message of a kind as it should be."""
        raise NotImplementedError

    def change(self, rng: random.Random, message: Any) -> None:
        """Damage a message."""
        raise NotImplementedError

    def give(self, kind: str, message: Any) -> tuple[str, list[str]]:
        """Give a message to the node; return in a word what became of it, and all words that are shown then."""
        raise NotImplementedError

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        kind = rng.choice(self.kinds)
        message = self.good(kind)
        for _ in range(how_often(rng)):
            self.change(rng, message)
        (content,) = serialised(rng, [message])
        return f"{kind}.cdr", content

    def run(self, name: str, content: bytes) -> str:
        kind = name.removesuffix(".cdr")
        messages = deserialised([content], [type(self.good(kind))])
        if messages is None:
            return "no message"
        faults = self._node.boundary.faults
        outcome, words = self.give(kind, messages[0])
        for sentence in (*self._node.said, *filter(None, words)):
            check_sentence(sentence)
        expect(not self._fatal, f"the node wants to end: {self._fatal}")
        if self._node.boundary.faults != faults:
            raise FailedError(f"something else than a SoftTissueError was raised: {self._node.said}")
        return outcome

    def close(self) -> None:
        self._node.close(2.0)
        self._node.destroy_node()
        rclpy.try_shutdown()
