"""The demo's live page: the viewer as a process beside the runs, which goes on after them."""

import contextlib
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.tools.processes import executable, relayed_process

START_TIMEOUT_S = 60.0


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
        if find_spec("cv2") is not None:
            command += ["-p", "image_transport:=compressed"]
        with relayed_process(command, log, "viewer") as viewer:
            address = _served_at(viewer, log)
            yield
            print(
                f"{address} shows what was recorded (untick live) and exports it; Ctrl-C ends it", flush=True
            )
            with contextlib.suppress(KeyboardInterrupt):
                viewer.wait()


def _served_at(viewer: "subprocess.Popen[str]", log: Path) -> str:
    """Wait until the viewer says at which address."""
    end = time.monotonic() + START_TIMEOUT_S
    while True:
        said = log.read_text(encoding="utf-8") if log.is_file() else ""
        if (found := re.search(r"serving (http\S+)\n", said)) is not None:
            return found[1]
        if viewer.poll() is not None:
            raise SoftTissueError(f"viewer: expected it to serve a page, got exit code {viewer.returncode}")
        if time.monotonic() > end:
            raise SoftTissueError(f"viewer: expected a page within {START_TIMEOUT_S:g} s, got none")
        time.sleep(0.05)
