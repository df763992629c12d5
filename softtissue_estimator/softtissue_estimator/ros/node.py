"""Executable `node`: runs the managed node."""

from typing import TYPE_CHECKING

from softtissue_estimator.ros.node_program import run_node
from softtissue_estimator.support.memory import one_pool

if TYPE_CHECKING:
    from softtissue_estimator.ros.command_line import Program
    from softtissue_estimator.ros.estimator_node import EstimatorNode

# After a signal, s: how long callbacks and the estimate in work are waited for, and when the process ends at last.
PATIENCE_S = 1.5
END_S = 2.5


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after wrong files or parameters, 1 after a crash."""
    one_pool()
    run_node(_program, _node_class, patience_s=PATIENCE_S, end_s=END_S, starts=True)


def _program() -> "Program":
    from softtissue_estimator.ros.command_line import NODE

    return NODE


def _node_class() -> "type[EstimatorNode]":
    from softtissue_estimator.ros.estimator_node import EstimatorNode

    return EstimatorNode


if __name__ == "__main__":
    main()
