"""Registrations on disk, so that the same command finds the same surface again and goes on from there."""

from __future__ import annotations

import contextlib
import hashlib
import time
from pathlib import Path

import numpy as np

import softtissue_training
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.support.files import is_file
from softtissue_training.core_sources import core_sources
from softtissue_training.experiments.breathing.case import BreathingCase
from softtissue_training.experiments.breathing.surface_tracking import TRACKERS, Progress, Tracked


def track_once(
    name: str, case: BreathingCase, motion: RigidMotion, folder: Path, progress: Progress
) -> tuple[Tracked, float]:
    """Track the surface in one of `TRACKERS`' ways, unless that was done before, and return also the seconds it took.

    The tetrahedra of an organ differ a little from one filling to the next, and so does what is found with them.

    Parameters
    ----------
    folder
        Where what is found is kept and looked for.
    """
    path = folder / f"tracking-{name}-{_key(case, motion)}.npz"
    if is_file(path):
        # A damaged file may raise anything: then that is done again.
        with (
            contextlib.suppress(Exception),
            path.open("rb") as stored,
            np.load(stored, allow_pickle=False) as file,
        ):
            before = RigidMotion(file["rotation"], file["translation"])
            return Tracked(before, file["displacement"], file["sigma"]), float(file["seconds"])
    start = time.perf_counter()
    tracked = TRACKERS[name](case, motion, progress)
    seconds = time.perf_counter() - start
    folder.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(
        partial,
        rotation=tracked.motion.rotation,
        translation=tracked.motion.translation,
        displacement=tracked.displacement,
        sigma=tracked.sigma,
        seconds=seconds,
    )
    # Under its name a file is complete.
    partial.replace(path)
    return tracked, seconds


def _key(case: BreathingCase, motion: RigidMotion) -> str:
    """Hash of all that a registration depends on: the case, the pose that it starts from, and the code."""
    content = hashlib.sha256(f"{case.organ.digest}\0{case.alignment}".encode())
    arrays = [case.surface.vertices, case.surface.faces, motion.rotation, motion.translation]
    if case.truth is not None:
        arrays += [case.truth.before, case.truth.after]
    for array in arrays:
        content.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    training = Path(softtissue_training.__file__).parent
    sources = [
        training / "experiments" / "breathing" / "surface_tracking.py",
        training / "experiments" / "coherent_point_drift.py",
        *core_sources(),
    ]
    for source in sources:
        content.update(source.read_bytes())
    return content.hexdigest()[:16]
