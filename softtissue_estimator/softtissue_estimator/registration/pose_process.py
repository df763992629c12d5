"""Find an organ's pose in another process, which leaves this one free for clouds.

The search keeps a core busy for seconds and holds Python's lock for parts of them.
"""

from __future__ import annotations

import os
import select
import subprocess
import tempfile
import threading
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.registration.find_pose import FoundPose, PoseFinder
from softtissue_estimator.registration.poses import PosePrior
from softtissue_estimator.support.arrays import save_arrays
from softtissue_estimator.support.leftovers import child_environment, contained, temporary_folder

FloatArray = NDArray[np.float64]

_WORKER = Path(__file__).with_name("pose_worker.py")
_TIMEOUT_S = 120.0  # twenty times what it takes


class PoseWorkerError(Exception):
    """What nobody expected was raised in the other process; its text holds the traceback."""


@dataclass(frozen=True, eq=False)
class PoseQuestion:
    """What `PoseFinder.find` takes.

    Attributes
    ----------
    surface
        Of the organ at rest, organ's frame, m.
    points, camera, start, landmarks, rejected
        See there.
    elastic
        How the organ bends, see `PoseFinder`.
    """

    surface: SurfaceMesh
    points: FloatArray
    camera: FloatArray | None = None
    start: PosePrior | None = None
    landmarks: tuple[FloatArray, FloatArray] | None = None
    rejected: tuple[RigidMotion, ...] = ()
    elastic: NDArray[np.float32] | None = None


def find_elsewhere(question: PoseQuestion) -> FoundPose:
    """Find a pose in another process that is not kept; see `PoseProcess.find`."""
    with closing(PoseProcess()) as process:
        return process.find(question)


class PoseProcess:
    """Another process, which keeps the organ that it has prepared for a minute after the last search.

    It ends with this one. Threads that ask at the same time wait for each other.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stack = ExitStack()
        self._child: subprocess.Popen[bytes] | None = None

    def prepare(self, surface: SurfaceMesh, elastic: NDArray[np.float32] | None = None) -> None:
        """Let it prepare an organ, as `PoseFinder` takes it, so that the first search takes less time."""
        with self._lock:
            self._asked(_organ_arrays(surface, elastic))

    def find(self, question: PoseQuestion) -> FoundPose:
        """Find a pose.

        Raises
        ------
        InvalidInputError
            If the question cannot be answered.
        PoseWorkerError
            If the other process failed.
        """
        with self._lock:
            return _found_of(self._asked(_arrays_of(question)))

    def close(self) -> None:
        """End the process; another question begins it anew."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        self._child = None
        self._stack.close()

    def _asked(self, question: dict[str, Any]) -> dict[str, Any]:
        """Ask, and begin the process where it does not run."""
        answer = None if self._child is None else self._answer(self._child, question)
        if answer is None:  # it may have ended just now
            self._end()
            answer = self._answer(self._begin(), question)
        if answer is None:
            self._errors.seek(0)
            said = self._errors.read().decode(errors="replace")
            self._end()
            raise PoseWorkerError(said or "the process ended without an answer")
        if "refused" in answer:
            raise InvalidInputError(str(answer["refused"]))
        return answer

    def _begin(self) -> subprocess.Popen[bytes]:
        self._folder = self._stack.enter_context(temporary_folder())
        self._errors = self._stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115 (the stack does)
        environment = child_environment(one_thread=True, folder=self._folder)
        self._child = self._stack.enter_context(
            contained([str(_WORKER)], self._folder, environment, self._errors)
        )
        return self._child

    def _answer(self, child: subprocess.Popen[bytes], question: dict[str, Any]) -> dict[str, Any] | None:
        """Return the answer; None where the process ends without one."""
        source, target = self._folder / "question.npz", self._folder / "answer.npz"
        save_arrays(source, question)
        stdin, stdout = child.stdin, child.stdout
        # One that is known to have ended is not written to: where SIGPIPE is not ignored that would end this one, too.
        if stdin is None or stdout is None or child.poll() is not None:
            return None
        try:
            os.write(stdin.fileno(), f"{source}\t{target}\n".encode())
        except OSError:
            return None
        poll = select.poll()
        poll.register(stdout, select.POLLIN)
        if not poll.poll(1e3 * _TIMEOUT_S):
            self._end()
            raise PoseWorkerError(f"expected a pose within {_TIMEOUT_S:.0f} s, got none")
        if os.read(stdout.fileno(), 1) != b"!":
            return None
        with np.load(target, allow_pickle=False) as answer:
            return dict(answer)


class Server:
    """The other process: keeps the organ that it was asked about last."""

    def __init__(self) -> None:
        self._key = b""
        self._finder: PoseFinder | None = None

    def serve(self, source: Path, target: Path) -> None:
        """Answer the question of one file in another."""
        with np.load(source, allow_pickle=False) as stored:
            arrays = dict(stored)
        answer: dict[str, Any]
        try:
            finder = self._prepared(SurfaceMesh(arrays["vertices"], arrays["faces"]), arrays.get("elastic"))
            answer = {} if "points" not in arrays else _arrays_of_found(_found(finder, _question_of(arrays)))
        except InvalidInputError as error:
            answer = {"refused": np.array(str(error))}
        save_arrays(target, answer)

    def _prepared(self, surface: SurfaceMesh, elastic: NDArray[np.float32] | None) -> PoseFinder:
        key = surface.vertices.tobytes() + surface.faces.tobytes()
        key += b"" if elastic is None else elastic.tobytes()
        if self._finder is None or key != self._key:
            self._finder, self._key = PoseFinder(surface, elastic), key
        return self._finder


def _found(finder: PoseFinder, question: PoseQuestion) -> FoundPose:
    return finder.find(
        question.points,
        camera=question.camera,
        start=question.start,
        landmarks=question.landmarks,
        rejected=question.rejected,
    )


def _organ_arrays(surface: SurfaceMesh, elastic: NDArray[np.float32] | None) -> dict[str, Any]:
    arrays = {"vertices": surface.vertices, "faces": surface.faces}
    return arrays if elastic is None else arrays | {"elastic": elastic}


def _arrays_of(question: PoseQuestion) -> dict[str, Any]:
    arrays = _organ_arrays(question.surface, question.elastic) | {"points": question.points}
    if question.rejected:
        arrays["rejected"] = np.stack(
            [np.column_stack([m.rotation, m.translation]) for m in question.rejected]
        )
    if question.camera is not None:
        arrays["camera"] = question.camera
    if question.start is not None:
        arrays |= _motion("start", question.start.mean) | {"start_covariance": question.start.covariance}
    if question.landmarks is not None:
        arrays |= {"on_organ": question.landmarks[0], "in_cloud": question.landmarks[1]}
    return arrays


def _question_of(stored: Any) -> PoseQuestion:
    return PoseQuestion(
        SurfaceMesh(stored["vertices"], stored["faces"]),
        stored["points"],
        stored.get("camera"),
        PosePrior(_read_motion(stored, "start"), stored["start_covariance"])
        if "start_covariance" in stored
        else None,
        (stored["on_organ"], stored["in_cloud"]) if "on_organ" in stored else None,
        tuple(RigidMotion(m[:, :3], m[:, 3]) for m in stored.get("rejected", ())),
        stored.get("elastic"),
    )


def _arrays_of_found(found: FoundPose) -> dict[str, Any]:
    second = {} if found.second is None else _motion("second", found.second)
    return {
        **_motion("motion", found.motion),
        **second,
        "covariance": found.covariance,
        "figures": np.array([found.rms_m, found.overlap, found.margin]),
        "ambiguous": np.array(found.ambiguous),
        "message": np.array(found.message),
    }


def _found_of(stored: Any) -> FoundPose:
    rms_m, overlap, margin = (float(number) for number in stored["figures"])
    return FoundPose(
        motion=_read_motion(stored, "motion"),
        covariance=stored["covariance"],
        rms_m=rms_m,
        overlap=overlap,
        ambiguous=bool(stored["ambiguous"]),
        second=_read_motion(stored, "second") if "second_rotation" in stored else None,
        margin=margin,
        message=str(stored["message"]),
    )


def _motion(name: str, motion: RigidMotion) -> dict[str, FloatArray]:
    return {f"{name}_rotation": motion.rotation, f"{name}_translation": motion.translation}


def _read_motion(stored: Any, name: str) -> RigidMotion:
    return RigidMotion(stored[f"{name}_rotation"], stored[f"{name}_translation"])
