"""Executable `igtl_bridge`: runs the node that serves OpenIGTLink."""

from softtissue_estimator.ros.node_program import run_node

_ROOM = "softtissue_estimator.ros.igtl_bridge"


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after arguments that cannot be used, 1 after a crash."""
    run_node(f"{_ROOM}.program:PROGRAM", f"{_ROOM}.bridge_node:BridgeNode", steps_back=True)


if __name__ == "__main__":
    main()
