"""How an executable starts its node, says in a sentence what is wrong, and ends in order after a signal."""

import sys
import time
from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any, NoReturn

from softtissue_estimator.ros.runtime import (
    Spinner,
    StopRequest,
    leave,
    limit_threads,
    refusal_of_ros,
    take_short_turns,
)
from softtissue_estimator.support.priority import step_back

BAD_INPUT = 2
CRASH = 1
# After a signal, s: how long callbacks and the work at hand are waited for, and when the process ends at last.
PATIENCE_S = 1.0
END_S = 2.0
Crash = Callable[[BaseException], None]


def run_node(
    program: str,
    node_class: str,
    *,
    patience_s: float = PATIENCE_S,
    end_s: float = END_S,
    starts: bool = False,
    steps_back: bool = False,
) -> NoReturn:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after input that cannot be used, 1 after a crash.

    Parameters
    ----------
    program : str
        Where that is which the command line is read for, "module:name" as of an entry point. It is imported when
        signals are caught.
    node_class : str
        Where the class of the node is, which is made with what takes an exception after which the process cannot go
        on. To import it takes seconds, for which nobody waits whose arguments are refused.
    patience_s : float
        How long callbacks and the work at hand are waited for after a signal.
    end_s : float
        After which the process ends at last.
    starts : bool
        Whether the node has a coroutine `start`, awaited first where its `autostart` says so, which returns what went
        wrong.
    steps_back : bool
        Whether other processes come first, as the `niceness` of the node's `settings` says.
    """
    stop = StopRequest(end_s)
    limit_threads()
    take_short_turns()
    profile = _join_ros(program)
    import rclpy

    from softtissue_estimator.errors import SoftTissueError

    crash = _crash_of(stop)
    node = _made(node_class, crash, stop)
    if steps_back:
        step_back(node.settings.niceness)
    node.get_logger().info(profile)

    async def start() -> None:
        failure = await node.start()
        if failure is not None:
            stop.stop(BAD_INPUT if isinstance(failure, SoftTissueError) else CRASH)

    spinner = Spinner(node, crash, node.boundary, start if starts and node.autostart else None)
    stop.event.wait()
    end = time.monotonic() + patience_s
    spinner.stop(patience_s)
    node.close(max(0.0, end - time.monotonic()))
    # Also while a thread still works, which does not touch it: without that its shared memory stays.
    node.destroy_node()
    rclpy.try_shutdown()
    leave(stop.exit_code)


def _join_ros(program: str) -> str:
    """Read the command line and begin with ROS 2; return a sentence about the transport's profile."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from softtissue_estimator.errors import SoftTissueError
    from softtissue_estimator.ros.command_line import parse_arguments
    from softtissue_estimator.ros.inputs.transport import use_profile

    try:
        parse_arguments(sys.argv[1:], resolve_name(program))
    except SoftTissueError as error:
        _refuse(str(error))
    profile = use_profile()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        _refuse(refusal_of_ros(error) or f"arguments: {error}")
    return profile


def _made(node_class: str, crash: Crash, stop: StopRequest) -> Any:
    """Import the node's class and make the node, unless the program was asked to end meanwhile."""
    from softtissue_estimator.errors import SoftTissueError

    try:
        make = resolve_name(node_class)
        stop.begin()
        return make(crash)
    except SoftTissueError as error:
        _refuse(str(error))
    except Exception as error:
        if (refusal := refusal_of_ros(error)) is None:
            raise
        _refuse(refusal)  # SROS2 without keys, say


def _crash_of(stop: StopRequest) -> Crash:
    import traceback

    def crash(error: BaseException) -> None:
        traceback.print_exception(error)
        stop.stop(CRASH)

    return crash


def _refuse(sentence: str) -> NoReturn:
    print(f"error: {sentence}", file=sys.stderr)
    leave(BAD_INPUT)
