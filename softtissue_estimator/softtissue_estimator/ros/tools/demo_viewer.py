"""The demo's live page: the viewer as a process beside the runs, which goes on after them."""

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.tools.processes import executable, relayed_process

START_TIMEOUT_S = 60.0
_SERVING = "serving http"


@contextmanager
def viewing(port: int | None) -> Iterator[None]:
    """Serve the page while the block runs and, unless it failed, afterwards until Ctrl-C; nothing without a port.

    Raises
    ------
    SoftTissueError
        If the page cannot be served: the viewer has said why.
    """
    if port is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="softtissue_viewer_") as folder:
        log = Path(folder) / "viewer.log"
        command = [str(executable("viewer")), "--ros-args", "-p", f"port:={port}"]
        command += ["-p", "image_transport:=compressed"]
        with relayed_process(command, log, "viewer") as viewer:
            _wait_until_served(viewer, log)
            yield
            print(
                "the page shows what was recorded (untick live), and exports it; Ctrl-C ends it", flush=True
            )
            with contextlib.suppress(KeyboardInterrupt):
                viewer.wait()


def _wait_until_served(viewer: "subprocess.Popen[str]", log: Path) -> None:
    end = time.monotonic() + START_TIMEOUT_S
    while not log.is_file() or _SERVING not in log.read_text(encoding="utf-8"):
        if viewer.poll() is not None:
            raise SoftTissueError(f"viewer: expected it to serve a page, got exit code {viewer.returncode}")
        if time.monotonic() > end:
            raise SoftTissueError(f"viewer: expected a page within {START_TIMEOUT_S:g} s, got none")
        time.sleep(0.05)
