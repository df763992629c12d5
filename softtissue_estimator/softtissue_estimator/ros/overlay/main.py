"""Executable `overlay`: starts the node and ends it in order."""

import sys

from softtissue_estimator.ros.runtime import (
    Spinner,
    StopRequest,
    leave,
    limit_threads,
    refusal_of_ros,
    take_short_turns,
)

# After a signal, s: how long callbacks and the image in work are waited for, and when the process ends at last.
PATIENCE_S = 1.0
END_S = 2.0
BAD_INPUT = 2
CRASH = 1


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after arguments that cannot be used, 1 after a crash."""
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
        # What is compiled the first time takes seconds.
        from softtissue_estimator.ros.overlay.overlay_node import PROGRAM, OverlayNode

        stop.begin()
        parse_arguments(sys.argv[1:], PROGRAM)
    except SoftTissueError as error:
        leave(_complain(str(error)))
    profile = use_profile()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        leave(_complain(refusal_of_ros(error) or f"arguments: {error}"))

    def crash(error: BaseException) -> None:
        traceback.print_exception(error)
        stop.stop(CRASH)

    try:
        node = OverlayNode(crash)
    except SoftTissueError as error:
        leave(_complain(str(error)))
    except Exception as error:
        if (refusal := refusal_of_ros(error)) is None:
            raise
        leave(_complain(refusal))  # SROS2 without keys, say
    node.get_logger().info(profile)
    spinner = Spinner(node, crash, node.boundary)
    stop.event.wait()
    spinner.stop(PATIENCE_S)
    node.close(PATIENCE_S)
    node.destroy_node()
    rclpy.try_shutdown()
    leave(stop.exit_code)


def _complain(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    main()
