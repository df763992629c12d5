"""What the node said last, and what of it may still be shown. May be asked from any thread."""

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.observation.rigid import inverse, transform_points
from softtissue_estimator.support.newest import keep_newest
from softtissue_estimator.view.structures import FloatArray, Structures
from softtissue_estimator.viewer.moment import CameraImage, Health, Level, Moment, Observed, ToolDistances

KEPT = 16
"""Answers, surfaces, poses and clouds that are kept, to put together what has the same stamp."""
STATUS_S = 5.0
"""After which the numbers of a status are no longer shown."""


@dataclass(frozen=True, eq=False)
class View:
    """What the page shows now.

    Attributes
    ----------
    level : str
    reason : str
        What is wrong; empty where all is well.
    structures : Structures or None
    moment : Moment or None
        None where nothing may be shown.
    health : Health or None
        The newest status; None where the last one is old.
    distances : ToolDistances or None
    image : CameraImage or None
        Newest image of the camera whose pose the moment has.
    """

    level: Level
    reason: str
    structures: Structures | None = None
    moment: Moment | None = None
    health: Health | None = None
    distances: ToolDistances | None = None
    image: CameraImage | None = None


@dataclass(frozen=True, eq=False)
class _Answer:
    arrived_s: float
    points: FloatArray
    sigma: FloatArray


class State:
    """Keeps the newest of each kind of message. All times are of one clock that never goes back, s."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._structures: Structures | None = None
        self._frame = ""
        self._answers: OrderedDict[int, _Answer] = OrderedDict()
        self._surfaces: OrderedDict[int, FloatArray] = OrderedDict()
        self._poses: OrderedDict[int, tuple[str, FloatArray]] = OrderedDict()
        self._clouds: OrderedDict[int, Observed] = OrderedDict()
        self._judged: OrderedDict[int, Observed] = OrderedDict()
        self._health: tuple[float, Health] | None = None
        self._distances: tuple[float, ToolDistances] | None = None
        self._image: tuple[float, CameraImage] | None = None
        self._moment: Moment | None = None

    @property
    def frame(self) -> str:
        """Frame of the organ; empty before the first."""
        return self._frame

    def take_structures(self, structures: Structures, frame: str) -> None:
        """Take what the rows of the answers are; answers before are of another organ, or of a node that has ended.

        Where nothing of them changed they stay the same object: whoever draws them need not begin anew.
        """
        with self._lock:
            if self._structures is None or not same(self._structures, structures):
                self._structures = structures
            self._frame = frame
            self._forget()
            self._distances = None

    def take_points(self, stamp_ns: int, points: FloatArray, sigma: FloatArray, now_s: float) -> None:
        """Take an answer: vertices of all structures, (n, 3) m, and their standard deviations, (n,) m."""
        with self._lock:
            keep_newest(self._answers, KEPT, stamp_ns, _Answer(now_s, points, sigma))

    def take_surface(self, stamp_ns: int, points: FloatArray) -> None:
        """Take the organ's surface that belongs to an answer, (k, 3) m."""
        with self._lock:
            keep_newest(self._surfaces, KEPT, stamp_ns, points)

    def take_pose(self, stamp_ns: int, frame: str, motion: FloatArray) -> None:
        """Take the pose (4, 4) of the organ in the frame of the cloud of that stamp."""
        with self._lock:
            keep_newest(self._poses, KEPT, stamp_ns, (frame, motion))

    def take_cloud(self, cloud: Observed) -> None:
        """Take observed points."""
        with self._lock:
            keep_newest(self._clouds, KEPT, cloud.stamp_ns, cloud)

    def take_judged(self, cloud: Observed) -> None:
        """Take the points of an answered cloud, which say on which of them the answer relies, in the cloud's place."""
        with self._lock:
            keep_newest(self._judged, KEPT, cloud.stamp_ns, cloud)

    def take_health(self, health: Health, now_s: float) -> None:
        """Take the newest status; where it is INVALID, the answers before it no longer hold."""
        with self._lock:
            self._health = now_s, health
            if health.level == "INVALID":
                self._forget()

    def take_distances(self, distances: ToolDistances, now_s: float) -> None:
        """Take the distances from a tool."""
        with self._lock:
            self._distances = now_s, distances

    def take_image(self, image: CameraImage, now_s: float) -> None:
        """Take an image of a camera."""
        with self._lock:
            self._image = now_s, image

    def view(self, now_s: float, maximum_age_s: float) -> View:
        """Return what may be shown: nothing from an answer that arrived longer ago than `maximum_age_s`."""
        with self._lock:
            structures = self._structures
            last = None if self._health is None else self._health[1]
            health = distances = None
            if self._health is not None and now_s - self._health[0] <= max(maximum_age_s, STATUS_S):
                health = last
            if self._distances is not None and now_s - self._distances[0] <= maximum_age_s:
                distances = self._distances[1]
            reason = self._refusal(now_s, maximum_age_s)
            moment = None if reason else self._newest()
            image = None if moment is None else self._image_of(moment.camera_frame, now_s, maximum_age_s)
        if last is not None and last.level == "INVALID":
            return View("INVALID", last.reason, structures, None, health, distances)
        if moment is None:
            return View("NO ESTIMATE", reason, structures, None, health, distances)
        return View(moment.level, moment.reason, structures, moment, health, distances, image)

    def _image_of(self, frame: str, now_s: float, maximum_age_s: float) -> CameraImage | None:
        if self._image is None or now_s - self._image[0] > maximum_age_s:
            return None
        return self._image[1] if self._image[1].frame == frame else None

    def _refusal(self, now_s: float, maximum_age_s: float) -> str:
        """Say why nothing may be shown; empty if something may."""
        structures = self._structures
        if structures is None:
            return "expected structures of the organ, got none"
        if not self._answers:
            return "expected an answer, got none"
        newest = next(reversed(self._answers.values()))
        age_s = now_s - newest.arrived_s
        if age_s > maximum_age_s:
            # Whole seconds: the sentence goes to the page anew only when it changes.
            return (
                f"expected an answer every {maximum_age_s:g} s (maximum_age_s), got none for {int(age_s)} s"
            )
        return _misfit(structures, newest.points)

    def _newest(self) -> Moment:
        """Return the newest answer; the moment stays the same object while nothing of it changed.

        Its surface and its points arrive just after the structures: until then the answer before is shown, which has
        both.
        """
        stamp, answer = next(reversed(self._answers.items()))
        before = [one for one in self._answers if one != stamp][-1:]
        if before and any(before[0] in kept and stamp not in kept for kept in (self._surfaces, self._judged)):
            earlier, structures = self._answers[before[0]], self._structures
            if structures is not None and not _misfit(structures, earlier.points):
                stamp, answer = before[0], earlier
        last = None if self._health is None else self._health[1]
        level: Level = "OK" if last is None else last.level
        reason = "" if last is None else last.reason
        moment = self._moment
        if (
            moment is None
            or (moment.stamp_ns, moment.time_s) != (stamp, answer.arrived_s)
            or (moment.surface is None and stamp in self._surfaces)
            or (not moment.judged and stamp in self._judged)
        ):
            self._moment = moment = self._put_together(stamp, answer)
        if (moment.level, moment.reason) != (level, reason):
            self._moment = moment = replace(moment, level=level, reason=reason)
        return moment

    def _put_together(self, stamp: int, answer: _Answer) -> Moment:
        structures = self._structures
        first_vertex = structures.first_vertex if structures is not None else np.zeros(1, np.int64)
        judged = self._judged.get(stamp)
        motion, observed = self._observed(stamp, self._clouds.get(stamp) if judged is None else judged)
        surface = self._surfaces.get(stamp)
        if surface is not None and not self._fits(surface):
            surface = None
        empty = np.zeros((0, 3), np.float32)
        return Moment(
            answer.arrived_s,
            stamp,
            answer.points.astype(np.float32),
            largest_sigma(answer.sigma, first_vertex),
            None if surface is None else surface.astype(np.float32),
            empty if observed is None else observed.points,
            np.zeros(0, bool) if observed is None else observed.left_out,
            motion,
            "" if motion is None else self._poses[stamp][0],
            judged=judged is not None,
        )

    def _fits(self, surface: FloatArray) -> bool:
        enough = self._structures is None or not self._structures.surface_misfit(surface)
        return enough and bool(np.isfinite(surface).all())

    def _observed(self, stamp: int, cloud: Observed | None) -> tuple[FloatArray | None, Observed | None]:
        """Return the pose of the cloud's frame and the cloud of an answer, in the organ's frame."""
        if cloud is not None and cloud.frame == self._frame:
            return None, cloud
        pose = self._poses.get(stamp)
        if pose is None or pose[0] == self._frame:
            return None, None
        motion = inverse(pose[1])
        if cloud is None or cloud.frame != pose[0]:
            return motion, None
        moved = transform_points(motion, cloud.points)
        return motion, replace(cloud, points=moved.astype(np.float32))

    def _forget(self) -> None:
        for kept in (self._answers, self._surfaces, self._poses, self._judged):
            kept.clear()
        self._moment = None


def largest_sigma(sigma: FloatArray, first_vertex: NDArray[np.int64]) -> FloatArray:
    """Return the largest standard deviation of each structure; NaN where none is known.

    Parameters
    ----------
    sigma : (n,) float64
        Of each vertex, m; NaN where none is known.
    first_vertex : (s + 1,) int64
        Rows of structure i begin at entry i and end before entry i + 1.

    Examples
    --------
    >>> largest_sigma(np.array([1.0, 3.0, np.nan]), np.array([0, 2, 3])).tolist()
    [3.0, nan]
    """
    parts = [sigma[first:last] for first, last in pairwise(first_vertex)]
    known = [part[~np.isnan(part)] for part in parts]
    return np.array([part.max() if len(part) else np.nan for part in known])


def same(first: Structures, second: Structures) -> bool:
    """Say whether structures are the same in all that is drawn."""
    if (first.names, first.kinds) != (second.names, second.kinds):
        return False
    one, other = _arrays(first), _arrays(second)
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def _arrays(structures: Structures) -> list[NDArray[Any]]:
    return [structures.colours, structures.first_vertex, structures.surface_faces, *structures.faces]


def _misfit(structures: Structures, points: FloatArray) -> str:
    """Say why an answer cannot be drawn; empty if it can."""
    finite = bool(np.isfinite(points).all())
    return structures.misfit(points) or (
        "" if finite else "expected finite positions in an answer, got others"
    )
