"""Calls of the node's services for the page's buttons; answers come as a sentence. Asked from any thread."""

import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from softtissue_msgs.srv import LoadOrgan, Register, Reset

_PATIENCE_S = 120.0
"""After which no answer is expected any more, as when the node has ended meanwhile."""
_MOST_WAITING = 8


@dataclass
class _Call:
    client: Any
    future: Any
    until_s: float


class Calls:
    """Asks the services in the executor's thread, one call of each at a time.

    Parameters
    ----------
    node : Node
    estimator : str
        Name of the node that is asked.
    answered : callable
        Takes a sentence.
    """

    def __init__(self, node: Node, estimator: str, answered: Callable[[str], None]) -> None:
        kinds = {"register": Register, "reset": Reset, "load_organ": LoadOrgan}
        self._clients = {
            name: node.create_client(kind, f"{estimator}/{name}") for name, kind in kinds.items()
        }
        self._answered = answered
        self._asked: queue.Queue[tuple[str, Any]] = queue.Queue(_MOST_WAITING)
        self._pending: dict[str, _Call] = {}

    def register(self) -> None:
        """Find the organ's pose in the newest cloud, and take it."""
        self._ask("register", Register.Request(apply=True))

    def reset(self) -> None:
        """Forget the present estimate."""
        self._ask("reset", Reset.Request())

    def load_organ(self, folder: str) -> None:
        """Change the organ."""
        self._ask("load_organ", LoadOrgan.Request(folder=folder.strip()))

    def _ask(self, name: str, request: Any) -> None:
        try:
            self._asked.put_nowait((name, request))
        except queue.Full:
            self._answered(f"{name}: expected fewer calls at a time, got {_MOST_WAITING} that wait")

    def work(self) -> None:
        """Send what was asked and say what was answered; called in the executor's thread."""
        while not self._asked.empty():
            self._send(*self._asked.get_nowait())
        for name, call in list(self._pending.items()):
            if call.future.done():
                del self._pending[name]
                self._answered(answer(name, call.future.result()))
            elif time.monotonic() > call.until_s or not call.client.service_is_ready():
                del self._pending[name]
                call.client.remove_pending_request(call.future)
                self._answered(f"{name}: expected an answer, got none; the node may have ended")

    def _send(self, name: str, request: Any) -> None:
        client = self._clients[name]
        if name in self._pending:
            self._answered(f"{name}: the call before is not answered yet")
        elif not client.service_is_ready():
            self._answered(f"{name}: expected the service {client.srv_name}, got none; is the node active?")
        else:
            self._answered(f"{name}: asked the node")
            until_s = time.monotonic() + _PATIENCE_S
            self._pending[name] = _Call(client, client.call_async(request), until_s)


def answer(name: str, response: Any) -> str:
    """Say in a sentence what a service answered."""
    done = response.result == type(response).SUCCESS
    return f"{name}: {response.message or ('done' if done else f'refused ({response.result})')}"
