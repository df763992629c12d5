"""How the executables start and end: signals, one thread that spins, exit codes."""

import argparse
import contextlib
import faulthandler
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine
from types import FrameType
from typing import Any, NoReturn

# Nothing heavy is imported here: signals must be caught before that begins.

_SWITCH_INTERVAL_S = 0.0005
_LAST_MARGIN_S = 2.0  # after the time in which the program should have ended


def limit_threads() -> None:
    """Keep linear algebra on one thread unless the user has said otherwise; call before numpy is imported.

    The matrices of a frame are small. OpenBLAS's threads wait for each other by spinning, and where something else
    takes one of the cores, a frame of 15 ms becomes one of 2 s.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def take_short_turns() -> None:
    """Let no thread keep Python's lock for long from one that asks for it.

    A frame gives the lock away in each of some hundred calls of libraries. Where another thread runs in Python, it gets
    the lock back only after a switch interval, of 5 ms unless said otherwise: a frame of 15 ms becomes one of a second.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)


class StopEvent:
    """What `threading.Event` is, but signals may set it: no lock, so that none is held when a handler runs."""

    def __init__(self) -> None:
        self._set = False
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)

    def wake_on_signals(self) -> None:
        """Let every signal that Python handles set it at once; call in the main thread.

        Handlers run in the main thread alone, and only when it is back from the library that it is in.
        """
        signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)

    def is_set(self) -> bool:
        """Say whether it is set."""
        return self._set

    def set(self) -> None:
        """Set it, and wake all who wait."""
        if not self._set:
            self._set = True
            os.write(self._writer, b"!")  # which nobody reads: the pipe stays readable

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, `timeout` seconds at most; return whether it is."""
        if not self._set:
            poll = select.poll()
            poll.register(self._reader, select.POLLIN)
            if poll.poll(None if timeout is None else max(0.0, 1e3 * timeout)):
                self._set = True
        return self._set


class StopRequest:
    """Set by SIGINT or SIGTERM, or by the program itself.

    Python's own handlers raise KeyboardInterrupt or kill, and rclpy's invalidate the context under a running
    callback; this one only takes note, so that everything ends in order.

    Parameters
    ----------
    within_s : float, optional
        The program ends after this time whatever it does: it may wait for a thread that does not end. Until `begin` is
        called it has nothing to bring to an end, and ends at once.
    """

    def __init__(self, within_s: float | None = None) -> None:
        self.event = StopEvent()
        self.exit_code = 0
        self._begun, self._within_s = False, within_s
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        self.event.wake_on_signals()
        if within_s is not None:
            threading.Thread(target=self._end_at_last, args=(within_s,), name="end", daemon=True).start()

    def begin(self) -> None:
        """Say that the imports are done and the program begins; does not return if it was asked to end meanwhile."""
        self._begun = True
        if self.event.is_set():
            leave(self.exit_code)

    def stop(self, exit_code: int = 0) -> None:
        """Ask the program to end; the first caller's exit code counts."""
        if not self.event.is_set():
            self.exit_code = exit_code
            self.event.set()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        if self._within_s is not None:
            # A library that never gives Python's lock back would keep the last resort below from its turn, too.
            faulthandler.dump_traceback_later(self._within_s + _LAST_MARGIN_S, exit=True)
        self.event.set()

    def _end_at_last(self, within_s: float) -> None:
        from softtissue_estimator.support import leftovers  # noqa: F401  # now, not when the time is up

        self.event.wait()
        if self._begun:
            time.sleep(within_s)
        leave(self.exit_code)


class Spinner:
    """Spins a node in a thread of its own.

    Parameters
    ----------
    node : Node
    on_error : callable
        Takes what a callback raised; the thread ends with it.
    boundary : Boundary, optional
        Inside it what a callback raises ends nothing.
    first : coroutine function, optional
        Awaited as soon as the thread spins.
    """

    def __init__(
        self,
        node: Any,
        on_error: Callable[[BaseException], None],
        boundary: Any = None,
        first: Callable[[], Coroutine[Any, Any, None]] | None = None,
    ) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.task import Future

        from softtissue_estimator.ros.bounded import BoundedExecutor

        self._node, self._on_error = node, on_error
        self._boundary = boundary
        self._executor = SingleThreadedExecutor() if boundary is None else BoundedExecutor(boundary)
        self._executor.add_node(node)
        if first is not None:
            self._executor.create_task(first)
        self._done: Any = Future()
        self._thread = threading.Thread(target=self._run, name="spin", daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """End after the callback at work; return whether the thread ended within `timeout_s`."""
        # Not Executor.shutdown: it destroys what the spinning thread still uses.
        self._done.set_result(None)
        self._thread.join(timeout_s)
        ended = not self._thread.is_alive()
        if ended:
            self._executor.shutdown()
        return ended

    def _run(self) -> None:
        try:
            self._spin()
        except Exception as error:  # reported by the owner, which ends the program
            self._on_error(error)

    def _spin(self) -> None:
        if self._boundary is not None:
            self._boundary.alive()
        while not self._done.done():
            try:
                self._executor.spin_until_future_complete(self._done)
                return
            except Exception as error:
                if self._boundary is None or not self._boundary.middleware_goes_on(error):
                    raise


def refusal_of_ros(error: BaseException) -> str | None:
    """Return in one line what ROS 2 refuses, if the error is rclpy's, whose classes are private; otherwise None."""
    if not type(error).__module__.startswith("rclpy."):
        return None
    from softtissue_estimator.support.sentences import one_sentence

    return one_sentence(f"ROS 2 refuses: {error}")


def leave(exit_code: int) -> NoReturn:
    """End the process at once; children and temporary files are removed, threads are not waited for.

    What an interpreter does at its end takes long, aborts where a thread still computes, and gives signals back to the
    operating system, which would end the process with another exit code.
    """
    from softtissue_estimator.support import leftovers

    leftovers.clear()
    with contextlib.suppress(OSError, ValueError):  # a closed terminal
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(exit_code)


def run_tool(
    parse: Callable[[list[str]], argparse.Namespace], run: Callable[[argparse.Namespace, StopRequest], int]
) -> NoReturn:
    """Run an executable that does one thing and ends: 0 or what `run` says; 2 for input that cannot be used.

    Parameters
    ----------
    parse : callable
        Takes the command line without ROS's own arguments.
    run : callable
        Takes what `parse` returned and a request to stop, and returns the exit code.
    """
    stop = StopRequest()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from softtissue_estimator.errors import SoftTissueError
    from softtissue_estimator.ros.command_line import outside_ros
    from softtissue_estimator.ros.inputs.transport import use_profile

    options = parse(outside_ros(sys.argv[1:]))
    use_profile()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        code = run(options, stop)
    except Exception as error:
        refusal = str(error) if isinstance(error, SoftTissueError) else refusal_of_ros(error)
        if refusal is None:
            raise
        print(f"error: {refusal}", file=sys.stderr)
        code = 2
    rclpy.try_shutdown()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(
            number, signal.SIG_IGN
        )  # the interpreter's end would give them back to the operating system
    sys.exit(code)
