"""Executable `node`: starts the managed node and ends it in order."""

import sys

from softtissue_estimator.ros.runtime import Spinner, StopRequest, leave, limit_threads

# What the process waits for after a signal: callbacks and the estimate in work, s.
PATIENCE_S = 2.0
BAD_INPUT = 2
CRASH = 1


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after wrong files or parameters, 1 after a crash."""
    stop = StopRequest()
    limit_threads()
    import traceback

    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from softtissue_estimator.errors import SoftTissueError
    from softtissue_estimator.ros.estimator_node import EstimatorNode
    from softtissue_estimator.ros.inputs.transport import use_profile

    profile = use_profile()
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own classes for bad arguments are private
        sys.exit(_complain(f"arguments: {error}"))

    def crash(error: BaseException) -> None:
        traceback.print_exception(error)
        stop.stop(CRASH)

    try:
        node = EstimatorNode(crash)
    except SoftTissueError as error:
        sys.exit(_complain(str(error)))
    node.get_logger().info(profile)

    def start() -> None:
        failure = node.start() if node.autostart else None
        if failure is not None:
            stop.stop(BAD_INPUT if isinstance(failure, SoftTissueError) else CRASH)

    spinner = Spinner(node, crash, start, node.boundary)
    stop.event.wait()
    orderly = spinner.stop(PATIENCE_S)
    orderly = node.close(PATIENCE_S) and orderly
    if orderly:
        node.destroy_node()
        rclpy.try_shutdown()
    leave(stop.exit_code, orderly)


def _complain(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    main()
