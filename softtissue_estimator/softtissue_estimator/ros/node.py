"""Executable `node`: starts the managed node and ends it in order."""

import sys
import time

from softtissue_estimator.ros.runtime import (
    Spinner,
    StopRequest,
    leave,
    limit_threads,
    refusal_of_ros,
    take_short_turns,
)
from softtissue_estimator.support.memory import one_pool

# After a signal, s: how long callbacks and the estimate in work are waited for, and when the process ends at last.
PATIENCE_S = 1.5
END_S = 2.5
BAD_INPUT = 2
CRASH = 1


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after wrong files or parameters, 1 after a crash."""
    one_pool()
    stop = StopRequest(END_S)
    limit_threads()
    take_short_turns()
    import traceback

    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from softtissue_estimator.errors import SoftTissueError
    from softtissue_estimator.ros.command_line import parse_arguments
    from softtissue_estimator.ros.inputs.transport import use_profile

    try:
        parse_arguments(sys.argv[1:])
    except SoftTissueError as error:
        leave(_complain(str(error)))
    profile = use_profile()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        leave(_complain(refusal_of_ros(error) or f"arguments: {error}"))
    # Seconds, for which nobody waits who is refused above.
    from softtissue_estimator.ros.estimator_node import EstimatorNode

    stop.begin()

    def crash(error: BaseException) -> None:
        traceback.print_exception(error)
        stop.stop(CRASH)

    try:
        node = EstimatorNode(crash)
    except SoftTissueError as error:
        leave(_complain(str(error)))
    except Exception as error:
        if (refusal := refusal_of_ros(error)) is None:
            raise
        leave(_complain(refusal))  # SROS2 without keys, say
    node.get_logger().info(profile)

    async def start() -> None:
        failure = await node.start()
        if failure is not None:
            stop.stop(BAD_INPUT if isinstance(failure, SoftTissueError) else CRASH)

    spinner = Spinner(node, crash, node.boundary, start if node.autostart else None)
    stop.event.wait()
    end_s = time.monotonic() + PATIENCE_S
    spinner.stop(PATIENCE_S)
    node.close(max(0.0, end_s - time.monotonic()))
    # Also while a thread still works, which does not touch it: without that its shared memory stays.
    node.destroy_node()
    rclpy.try_shutdown()
    leave(stop.exit_code)


def _complain(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    main()
