"""Damaged answers, clouds, images and distances, put into the callbacks of a whole viewer in this process."""

import math
import random
import time
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.images import SAID, change, good_message
from fuzz.kind import MissingError, expect
from fuzz.whole_node import WholeNode

try:
    import viser  # noqa: F401
    from geometry_msgs.msg import Point
    from softtissue_msgs.msg import Distances

    from fuzz.images import MISSING
    from fuzz.message_damage import FLOATS, FRAMES, changed_header
    from integration.scene import cloud_message
    from softtissue_estimator.ros.inputs.conversions import make_cloud
    from softtissue_estimator.ros.viewer.viewer_node import ViewerNode
    from softtissue_estimator.support.sentences import one_sentence
except ImportError as error:
    MISSING = str(error)

_STAMP = 10**18
_CLOUDS = ("surface_points", "observed_points")
_PICTURES = ("image", "camera_info")
_KINDS = (*SAID, *_CLOUDS * 2, *_PICTURES, "tool_distances", "tool_distances")
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("used", "u1")])


class Pages(WholeNode):
    """What a viewer hears, and the page that it shows after each message."""

    name = "pages"
    share = 3
    kinds = _KINDS

    def __init__(self, folder: Path) -> None:
        if MISSING:
            raise MissingError(MISSING)
        # What is recorded of the messages would count as memory of the one at work.
        arguments = ["-p", "port:=0", "-p", "image_transport:=raw", "-p", "recording_mb:=1"]
        super().__init__(folder, _WatchedViewer, arguments)
        self._subscriptions = {s.topic_name.rpartition("/")[2]: s for s in self._node.subscriptions}
        self._first = self._shown_well()

    def change(self, rng: random.Random, message: Any) -> None:
        if isinstance(message, Distances):
            _distances(rng, message)
        else:
            change(rng, message)

    def give(self, kind: str, message: Any) -> tuple[str, list[str]]:
        # Of an organ everything else is said; what ends it comes first, the other one last.
        if kind == "structures":
            self._node.said.clear()
            self._tell(kind, message)
            self._tell_all_but(kind)
        else:
            self._tell_all_but(kind)
            self._node.said.clear()
            self._tell(kind, message)
        view = self._node.show()
        if view.moment is not None and not self._node.said:
            _check(view.moment)
        outcome = "shown" if view.moment is not None else "not shown"
        return "refused" if self._node.said else outcome, _words(view)

    def check_good(self) -> None:
        expect(
            np.array_equal(self._shown_well(), self._first), "a good answer is shown otherwise than at first"
        )

    def _tell(self, kind: str, message: Any) -> None:
        self._node.forget_time()
        self._subscriptions[kind].callback(message)

    def _tell_all_but(self, kind: str) -> None:
        for other in (*SAID, *_CLOUDS, *_PICTURES, "tool_distances"):
            if other != kind:
                self._tell(other, self.good(other))

    def _shown_well(self) -> np.ndarray:
        self._tell_all_but("")
        self._node.said.clear()
        view = self._node.show()
        expect(view.moment is not None, f"a good answer is not shown: {view.reason} {self._node.said}")
        expect(view.moment.judged and view.moment.surface is not None, "a good answer is not whole")
        expect(view.distances is not None and view.image is not None, "no distances or no image are shown")
        _check(view.moment)
        return np.concatenate([view.moment.points, view.moment.surface, view.moment.observed])

    def good(self, kind: str) -> Any:
        organ = self._organ
        if kind == "surface_points":
            return cloud_message(organ.surface.vertices, ["x", "y", "z"], _STAMP, "camera")
        if kind == "observed_points":
            vertices = organ.surface.vertices
            table = np.zeros(len(vertices), dtype=_POINT)
            for axis, name in enumerate("xyz"):
                table[name] = vertices[:, axis]
            table["used"] = np.arange(len(table)) % 2
            return make_cloud(table, "camera", _STAMP)
        if kind == "tool_distances":
            count = len(organ.structures)
            told = Distances(
                names=[one.name for one in organ.structures],
                kinds=[one.kind for one in organ.structures],
                distance=[0.01] * count,
                sigma=[0.001] * count,
                covariance=[0.0] * 9 * count,
                ahead=[math.nan] * count,
                ahead_sigma=[math.nan] * count,
            )
            told.header.frame_id = organ.frame
            told.nearest = [Point(x=0.01, y=0.0, z=0.0) for _ in range(count)]
            return told
        return good_message(kind, organ)


def _words(view: Any) -> list[str]:
    """Return all words of messages that a page may show."""
    words = [view.reason]
    for named in (view.structures, view.distances):
        words += [] if named is None else named.names
    return words + ([] if view.health is None else [view.health.reason, *view.health.about])


def _check(moment: Any) -> None:
    """Raise FailedError unless what is drawn are numbers that fit one another."""
    arrays = [moment.points, moment.observed, *([] if moment.surface is None else [moment.surface])]
    expect(all(bool(np.isfinite(array).all()) for array in arrays), "positions that are not finite are drawn")
    expect(len(moment.left_out) == len(moment.observed), "not a word of each observed point")
    expect(moment.camera is None or bool(np.isfinite(moment.camera).all()), "a camera nowhere")


def _distances(rng: random.Random, told: Any) -> None:
    what = rng.randrange(4)
    if what == 0:
        changed_header(rng, told.header)
    elif what == 1:
        name = rng.choice(("names", "kinds", "distance", "sigma", "nearest", "covariance", "ahead"))
        setattr(told, name, list(getattr(told, name))[: rng.choice((0, 1, 2))])
    elif what == 2:
        name = rng.choice(("distance", "sigma"))
        values = list(getattr(told, name))
        if values:
            values[rng.randrange(len(values))] = rng.choice(FLOATS)
        setattr(told, name, values)
    elif told.names:
        name = rng.choice(("names", "kinds"))
        words = list(getattr(told, name))
        if words:
            words[rng.randrange(len(words))] = rng.choice(FRAMES)
        setattr(told, name, words)


if not MISSING:

    class _WatchedViewer(ViewerNode):
        """Shows when it is told to, and keeps what it says."""

        def __init__(self, on_crash: Any) -> None:
            self.said: list[str] = []
            super().__init__(on_crash)
            self.boundary.warn = lambda text: self.said.append(one_sentence(text))  # as it logs them

        def forget_time(self) -> None:
            """Take the next image however soon it comes."""
            self._pictures._taken_s = -math.inf

        def show(self) -> Any:
            """Show what is now as the thread of the page does, with what it takes for a fault; return the view."""
            self.boundary.guarded("page", self._show)(True)
            return self._state.view(time.monotonic(), self.settings.maximum_age_s)
