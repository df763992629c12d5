"""Find an organ's pose in another process, which leaves this one free for clouds.

The search keeps a core busy for seconds and holds Python's lock for parts of them.
"""

from __future__ import annotations

import subprocess
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
from softtissue_estimator.support.leftovers import child_environment, run_contained, temporary_folder

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
    points, camera, start, landmarks
        See there.
    """

    surface: SurfaceMesh
    points: FloatArray
    camera: FloatArray | None = None
    start: PosePrior | None = None
    landmarks: tuple[FloatArray, FloatArray] | None = None


def find_elsewhere(question: PoseQuestion) -> FoundPose:
    """Find a pose in another process, which ends with this one.

    Raises
    ------
    InvalidInputError
        If the question cannot be answered.
    PoseWorkerError
        If the other process failed.
    """
    with temporary_folder() as folder:
        source, target = folder / "question.npz", folder / "answer.npz"
        np.savez(source, **_arrays_of(question), allow_pickle=False)
        environment = child_environment(one_thread=True, folder=folder)
        try:
            done = run_contained([str(_WORKER), str(source), str(target)], folder, environment, _TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise PoseWorkerError(f"expected a pose within {_TIMEOUT_S:.0f} s, got none") from error
        if done.returncode != 0:
            raise PoseWorkerError(done.stderr or f"the process ended with {done.returncode}")
        with np.load(target, allow_pickle=False) as answer:
            if "refused" in answer:
                raise InvalidInputError(str(answer["refused"]))
            return _found_of(answer)


def serve(source: Path, target: Path) -> None:
    """Be the other process: answer the question of one file in another."""
    with np.load(source, allow_pickle=False) as stored:
        question = _question_of(stored)
    answer: dict[str, Any]
    try:
        found = PoseFinder(question.surface).find(
            question.points, camera=question.camera, start=question.start, landmarks=question.landmarks
        )
        answer = _arrays_of_found(found)
    except InvalidInputError as error:
        answer = {"refused": np.array(str(error))}
    np.savez(target, **answer, allow_pickle=False)


def _arrays_of(question: PoseQuestion) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        "vertices": question.surface.vertices,
        "faces": question.surface.faces,
        "points": question.points,
    }
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
