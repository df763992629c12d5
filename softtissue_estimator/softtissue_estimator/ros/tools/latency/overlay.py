"""The overlay beside the node under test: its process, a camera for it, and how long images are on their way."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.ros.tools.latency.camera import REGISTRATION
from softtissue_estimator.ros.tools.latency.control import Remote, open_remote
from softtissue_estimator.ros.tools.latency.statistics import latencies_ms, quantiles
from softtissue_estimator.ros.tools.latency.usage import cpu_share, usage_of
from softtissue_estimator.ros.tools.processes import executable, relayed_process


@dataclass(frozen=True)
class Images:
    """Images that the overlay gets: columns and rows, and images a second."""

    columns: int
    rows: int
    rate_hz: float

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}@{self.rate_hz:g}"


def parse_images(text: str) -> Images:
    """Read COLUMNSxROWS@RATE.

    Raises
    ------
    InvalidInputError
        If it is something else.
    """
    size, _, rate = text.partition("@")
    columns, _, rows = size.partition("x")
    try:
        images = Images(int(columns), int(rows), float(rate))
    except ValueError:
        images = Images(0, 0, 0.0)
    if min(images.columns, images.rows) < 16 or not 0.1 <= images.rate_hz <= 1000.0:
        raise InvalidInputError(f"--overlay: expected COLUMNSxROWS@RATE, for example 640x480@25, got {text}")
    return images


class Overlay:
    """An overlay and its camera, which run; made by `open_overlay`."""

    def __init__(self, child: "subprocess.Popen[str]", camera: Remote, images: Images) -> None:
        self._child, self._camera, self._images = child, camera, images
        self._before = usage_of(child.pid)

    def connected(self) -> bool:
        """Say whether images pass.

        Raises
        ------
        SoftTissueError
            If the overlay has ended.
        """
        if self._child.poll() is not None:
            raise SoftTissueError(f"overlay: expected one that runs, got exit code {self._child.returncode}")
        return bool(self._camera.ask("connected")["connected"])

    def begin(self) -> None:
        """Begin to send images."""
        self._camera.ask("begin")

    def measure(self) -> None:
        """Begin to count its processor time."""
        self._before = usage_of(self._child.pid)

    def end(self, warm_up_s: float) -> dict[str, Any]:
        """Stop; return the figures of the images after a time that is not measured."""
        after = usage_of(self._child.pid)
        found = self._camera.ask("end")
        sent = found["stamps"]
        measured = (
            frozenset(stamp for stamp in sent if stamp >= sent[0] + 1e9 * warm_up_s) if sent else frozenset()
        )
        shown = [pair for pair in found["shown"] if pair[0] in measured]
        return {
            "images": str(self._images),
            "columns": self._images.columns,
            "rows": self._images.rows,
            "rate_hz": self._images.rate_hz,
            "sent": len(measured),
            "shown": len(shown),
            **quantiles(latencies_ms(shown, measured)),
            "cpu_share": round(cpu_share(self._before, after), 3),
            "rss_mb": round(after.rss_mb, 1),
        }


@contextmanager
def open_overlay(
    organ: Path, images: Images, namespace: str, folder: Path, wait: Callable[[Callable[[], bool], str], None]
) -> Iterator[Overlay]:
    """Run an overlay in a namespace, and a camera that looks at the organ in a folder; `wait` until images pass."""
    with ExitStack() as stack:
        command = [str(executable("overlay")), "--ros-args", "-r", f"__ns:={namespace}"]
        command += ["-r", f"registration:={REGISTRATION}", "-p", "maximum_age_s:=1.0"]
        child = stack.enter_context(relayed_process(command, folder / "overlay.log", "overlay"))
        seen = (str(organ), str(images.columns), str(images.rows), f"{images.rate_hz:g}")
        camera = stack.enter_context(open_remote("camera", namespace, *seen))
        overlay = Overlay(child, camera, images)
        wait(overlay.connected, "images to pass through the overlay")
        yield overlay
