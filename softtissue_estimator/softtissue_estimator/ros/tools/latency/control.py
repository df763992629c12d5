"""Questions from one process to another and back: a line of JSON each, on standard input and output."""

import json
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.runtime import Spinner, StopRequest
from softtissue_estimator.ros.tools.processes import process

Handler = Callable[..., dict[str, Any]]
_PATIENCE_S = 2.0  # for the callback at work when a process ends


def crash_of(stop: StopRequest) -> Callable[[BaseException], None]:
    """Return what takes an exception after which a process cannot go on: prints it, and asks for exit code 1."""

    def crash(error: BaseException) -> None:
        traceback.print_exception(error)
        stop.stop(1)

    return crash


def serve_spinning(node: Any, handlers: Mapping[str, Handler], stop: StopRequest) -> None:
    """Answer questions as `serve_until_stopped` does, while a thread spins a node."""
    spinner = Spinner(node, crash_of(stop))
    serve_until_stopped(handlers, stop)
    spinner.stop(_PATIENCE_S)


def serve_until_stopped(handlers: Mapping[str, Handler], stop: StopRequest) -> None:
    """Answer questions, in a thread of its own, until standard input ends or the process is asked to end."""

    def run() -> None:
        serve(handlers)
        stop.stop()

    threading.Thread(target=run, name="serve", daemon=True).start()
    stop.event.wait()


def serve(handlers: Mapping[str, Handler]) -> None:
    """Answer questions until standard input ends; a SoftTissueError becomes an answer."""
    for line in sys.stdin:
        question = json.loads(line)
        try:
            answer = handlers[question.pop("do")](**question)
        except SoftTissueError as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)


class Remote:
    """A process that serves questions.

    Parameters
    ----------
    child : subprocess.Popen
        Started with pipes as standard input and output.
    name : str
        For messages.
    """

    def __init__(self, child: "subprocess.Popen[str]", name: str) -> None:
        self.child, self._name = child, name

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        """Put a question and wait for the answer.

        Raises
        ------
        SoftTissueError
            If the process says that it cannot, or is gone.
        """
        if self.child.stdin is None or self.child.stdout is None:
            raise SoftTissueError(f"{self._name}: expected a process with pipes, got one without")
        try:
            self.child.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
            self.child.stdin.flush()
            line = self.child.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise SoftTissueError(
                f"{self._name}: expected an answer to {do!r}, got the end of the process,"
                f" exit code {self.child.wait()}"
            )
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise SoftTissueError(str(answer["error"]))
        return answer


@contextmanager
def open_remote(module: str, namespace: str, *arguments: str) -> Iterator[Remote]:
    """Run a module of this package that serves questions, as a process whose nodes are in a namespace."""
    command = [sys.executable, "-m", f"{__package__}.{module}", *arguments]
    command += ["--ros-args", "-r", f"__ns:={namespace}"]
    with process(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        yield Remote(child, module)
