"""`registration_source: auto`: the node searches for the organ where no registration is, and after it was lost."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.srv import DecideRegistration

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.find_pose import FoundPose
from softtissue_estimator.registration.pose_process import PoseProcess
from softtissue_estimator.ros.cloud_poses import CloudPlace, place_of, pose_question
from softtissue_estimator.ros.frames import Frame
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration
from softtissue_estimator.support.latest_worker import LatestWorker

PATIENCE_S = 0.5
"""So long an organ that was followed may be away before it is searched for: it may come back where it was."""
_MOST_REJECTED = 16


@dataclass(frozen=True, eq=False)
class _Task:
    frame: Frame | None
    organ: Organ


class OrganSearch:
    """Searches one cloud at a time while the organ is not where it is expected, and knows what was decided.

    Of what is found, only a pose that is not ambiguous becomes the registration. An ambiguous one is offered: it waits
    until somebody accepts it, or a later search finds a sure one.

    Methods may be called from any thread.

    Parameters
    ----------
    registration : Registration
        Takes what is found.
    config : callable
        Returns the configuration as it is now.
    explain : callable
        Takes what was being done and an exception, and returns a sentence.
    say : callable
        Takes what was found, in a sentence.
    poses : PoseProcess
        Searches.
    elastic : callable
        Returns how an organ bends, as `PoseFinder` takes it, or None; may take a tenth of a second the first time.
    """

    def __init__(
        self,
        registration: Registration,
        config: Callable[[], EstimatorConfig],
        explain: Callable[[str, BaseException], str],
        say: Callable[[str], None],
        poses: PoseProcess,
        elastic: Callable[[Organ], NDArray[np.float32] | None] = lambda _organ: None,
    ) -> None:
        self._registration, self._config = registration, config
        self._explain, self._say, self._poses, self._elastic = explain, say, poses, elastic
        self._lock = threading.Lock()
        self._worker: LatestWorker[_Task] | None = None
        self._task: _Task | None = None
        self._away_since_s: float | None = None
        self._said = ""
        self._offered: OrganPose | None = None
        self._accepted: OrganPose | None = None
        self._rejected: list[OrganPose] = []
        self._organ: Organ | None = None

    @property
    def state(self) -> str:
        """Where the registration comes from, as `EstimatorStatus.registration` has it."""
        with self._lock:
            return self._state()

    def _state(self) -> str:
        newest = self._registration.newest
        if self._registration.frozen:
            return "frozen"
        if newest is not None and newest is self._accepted:
            return "accepted"
        if self._task is not None:
            return "searching"
        if newest is None:
            return "none"
        return "found" if newest.found else "given"

    def begin(self, organ: Organ) -> None:
        """Say which organ is at work: what was found or decided about another one is forgotten."""
        with self._lock:
            if organ is self._organ:
                return
            before, self._organ = self._organ, organ
            newest = self._registration.newest
            if before is None or np.array_equal(before.surface.vertices, organ.surface.vertices):
                return
            self._task = self._offered = self._accepted = None
            self._rejected.clear()
            self._registration.frozen = False
            if newest is not None and newest.found:
                self._registration.withdraw()

    def answered(self) -> None:
        """Say that the organ is where it is expected: what is searched for is not needed any more."""
        with self._lock:
            self._task = self._away_since_s = self._offered = None
            self._said = ""

    def away(self, frame: Frame, organ: Organ, reason: str) -> str:
        """Say that a cloud does not show the organ where it is expected; begin a search where that is due.

        Returns
        -------
        str
            Why the cloud is not answered, and what is done about it.
        """
        if self._config().registration_source != "auto":
            return reason
        with self._lock:
            state, now = self._state(), time.monotonic()
            if state in ("accepted", "frozen"):
                return f"{reason}; the registration is {state}, so that no other is searched for"
            known = self._registration.newest is not None
            if self._away_since_s is None:
                self._away_since_s = now
            if self._task is None and (not known or now - self._away_since_s >= PATIENCE_S):
                self._task = _Task(frame, organ)
                self._put(self._task)
            if self._task is None:
                return reason
            said = self._said or (reason if known else "expected a registration, got none yet")
            return f"searching for the organ in the cloud, for {now - self._away_since_s:.0f} s: {said}"

    def prepare(self, organ: Organ) -> None:
        """Let the search prepare an organ before it is needed, where it may be."""
        if self._config().registration_source == "auto":
            with self._lock:
                self._put(_Task(None, organ))

    def _put(self, task: _Task) -> None:
        if self._worker is None:
            self._worker = LatestWorker(self._work, lambda error: self._explain("search", error), "search")
        self._worker.put(task)

    def _work(self, task: _Task) -> None:
        if task.frame is None:
            self._poses.prepare(task.organ.surface, self._elastic(task.organ))
            return
        began_s = time.monotonic()
        try:
            place, found = self._found(task, task.frame.cloud)
        except Exception as error:  # whatever it is, the next cloud begins another search
            said = self._explain("search", error)
            with self._lock:
                if self._task is task:
                    self._task, self._said = None, said
            return
        self._say(f"searched a cloud for the organ for {time.monotonic() - began_s:.1f} s: {found.message}")
        registration = place.registration(found, task.organ)
        with self._lock:
            if self._task is not task:
                return  # the organ came back, or is another one, or somebody decided
            self._task = None
            self._take(found, registration)

    def _found(self, task: _Task, cloud: PointCloud2) -> tuple[CloudPlace, FoundPose]:
        config, cameras = self._config(), self._registration.cameras
        place = place_of(cloud, cameras, config.registration_max_age_s)
        with self._lock:
            wrong = [place.in_cloud(pose) for pose in self._rejected]
        rejected = tuple(motion for motion in wrong if motion is not None)
        elastic = self._elastic(task.organ)
        question = pose_question(cloud, task.organ, config, cameras, rejected=rejected, elastic=elastic)
        return place, self._poses.find(question)

    def _take(self, found: FoundPose, registration: OrganPose | None) -> None:
        if registration is None:
            self._said = "expected the camera's pose at the cloud in which the organ was found, got none"
        elif found.ambiguous:
            self._offered = registration
            self._said = f"{found.message}; it is not used unless ~/decide_registration accepts it"
        else:
            try:
                self._registration.take(registration)
            except SoftTissueError as error:  # frozen meanwhile
                self._said = str(error)
                return
            self._said, self._offered, self._away_since_s = "", None, None

    def decide(self, decision: int, response: DecideRegistration.Response) -> DecideRegistration.Response:
        """Answer `~/decide_registration`."""
        codes = DecideRegistration.Request
        names = {codes.ACCEPT: "accepted", codes.REJECT: "rejected", codes.FREEZE: "frozen"}
        response.result = DecideRegistration.Response.INVALID
        if decision not in names:
            response.message = f"decision: expected ACCEPT (1), REJECT (2) or FREEZE (3), got {decision}"
            return response
        with self._lock:
            pose = self._offered or self._registration.newest
            if pose is None:
                response.message = "expected a registration to decide about, got none yet"
            elif decision == codes.REJECT and not pose.found:
                response.message = "expected a registration that the node found, got one that was given"
            else:
                self._settle(decision, pose)
                response.result = DecideRegistration.Response.SUCCESS
                response.message = f"the registration is {names[decision]}"
        return response

    def _settle(self, decision: int, pose: OrganPose) -> None:
        codes, offered = DecideRegistration.Request, self._offered is not None
        self._task = self._offered = self._away_since_s = None
        self._said = ""
        if not offered or decision != codes.REJECT:
            self._registration.frozen = False
        if decision == codes.REJECT:
            self._rejected = [*self._rejected, pose][-_MOST_REJECTED:]
            self._said = "the pose that was found is rejected"
            if not offered:
                self._accepted = None
                self._registration.withdraw()
            return
        if offered:
            self._registration.take(pose)
        self._accepted = self._registration.newest
        self._registration.frozen = decision == codes.FREEZE
