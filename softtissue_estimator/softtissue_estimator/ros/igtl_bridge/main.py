"""Executable `igtl_bridge`: runs the node that serves OpenIGTLink."""

from typing import TYPE_CHECKING

from softtissue_estimator.ros.node_program import run_node

if TYPE_CHECKING:
    from softtissue_estimator.ros.command_line import Program
    from softtissue_estimator.ros.igtl_bridge.bridge_node import BridgeNode

# After a signal, s: how long callbacks and the thread of the sockets are waited for, and when the process ends at last.
PATIENCE_S = 1.0
END_S = 2.0


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after arguments that cannot be used, 1 after a crash."""
    run_node(_program, _node_class, patience_s=PATIENCE_S, end_s=END_S)


def _program() -> "Program":
    from softtissue_estimator.ros.igtl_bridge.program import PROGRAM

    return PROGRAM


def _node_class() -> "type[BridgeNode]":
    from softtissue_estimator.ros.igtl_bridge.bridge_node import BridgeNode

    return BridgeNode


if __name__ == "__main__":
    main()
