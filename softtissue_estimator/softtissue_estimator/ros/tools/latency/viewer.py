"""The viewer beside the node under test: its process, which serves its page to nobody."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.tools.latency.usage import cpu_share, usage_of
from softtissue_estimator.ros.tools.processes import executable, relayed_process

VIEWER = "softtissue_viewer"


class Viewer:
    """A viewer that runs; made by `open_viewer`."""

    def __init__(self, child: "subprocess.Popen[str]") -> None:
        self._child = child
        self.measure()

    def measure(self) -> None:
        """Begin to count its processor time."""
        self._before = usage_of(self._child.pid)

    def end(self) -> dict[str, Any]:
        """Return what it has used since then."""
        after = usage_of(self._child.pid)
        return {"cpu_share": round(cpu_share(self._before, after), 3), "rss_mb": round(after.rss_mb, 1)}


@contextmanager
def open_viewer(
    ros_node: Any, namespace: str, folder: Path, wait: Callable[[Callable[[], bool], str], None]
) -> Iterator[Viewer]:
    """Run a viewer in a namespace; `wait` until it hears the clouds, the last of its topics."""
    command = [str(executable("viewer")), "--ros-args", "-r", f"__ns:={namespace}", "-p", "port:=0"]
    with relayed_process(command, folder / "viewer.log", "viewer") as child:
        wait(lambda: _hears(child, ros_node, namespace), "a viewer that hears clouds")
        yield Viewer(child)


def _hears(child: "subprocess.Popen[str]", ros_node: Any, namespace: str) -> bool:
    if child.poll() is not None:
        raise SoftTissueError(f"viewer: expected one that runs, got exit code {child.returncode}")
    heard = ros_node.get_subscriptions_info_by_topic(f"{namespace}/surface_points")
    return any(one.node_name == VIEWER for one in heard)
