"""Executable `node`: runs the managed node."""

from softtissue_estimator.ros.node_program import run_node
from softtissue_estimator.support.memory import one_pool

# After a signal, s: how long callbacks and the estimate in work are waited for, and when the process ends at last.
PATIENCE_S = 1.5
END_S = 2.5


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after wrong files or parameters, 1 after a crash."""
    one_pool()
    run_node(
        "softtissue_estimator.ros.command_line:NODE",
        "softtissue_estimator.ros.estimator_node:EstimatorNode",
        patience_s=PATIENCE_S,
        end_s=END_S,
        starts=True,
    )


if __name__ == "__main__":
    main()
