"""Executable `overlay`: runs the node that draws on images."""

from softtissue_estimator.ros.node_program import run_node

_ROOM = "softtissue_estimator.ros.overlay"


def main() -> None:
    """Run until SIGINT or SIGTERM (exit code 0); 2 after arguments that cannot be used, 1 after a crash."""
    run_node(f"{_ROOM}.program:PROGRAM", f"{_ROOM}.overlay_node:OverlayNode", steps_back=True)


if __name__ == "__main__":
    main()
