"""The suite's motions on disk: simulated once, gone on with after an interruption."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.evaluation.streams.plan import StreamPlan, organ_name
from softtissue_training.simulation.motion_format import format_motion, parse_motion
from softtissue_training.simulation.moving_organ import MotionSettings, MovingOrgan, simulate_motion

_Task = tuple[int, int, MotionSettings]


def make_motions(plan: StreamPlan, folder: Path, *, workers: int, show_progress: bool = True) -> list[str]:
    """Simulate the motions that a folder lacks, one file an organ.

    Parameters
    ----------
    workers
        Processes; 0 works in this one.

    Returns
    -------
    list
        Hash of each organ's motion.

    Raises
    ------
    InvalidInputError
        The folder holds motions of another seed or of other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(plan.organs) if not motion_path(folder, number).is_file()]
    tasks = [(plan.seed, number, plan.motion) for number in missing]
    with (
        environment(ONE_THREAD),
        tqdm(
            total=plan.organs,
            initial=plan.organs - len(missing),
            unit="organ",
            desc="simulating motions",
            disable=not show_progress,
        ) as bar,
    ):
        for number, content in _simulated(tasks, workers):
            path = motion_path(folder, number)
            partial = path.with_suffix(f".partial{os.getpid()}")
            partial.write_bytes(content)
            partial.replace(path)
            bar.update()
    return [_hash(read_motion(folder, number, plan)) for number in range(plan.organs)]


def _simulated(tasks: list[_Task], workers: int) -> Iterator[tuple[int, bytes]]:
    return map(_simulate, tasks) if workers == 0 or not tasks else in_processes(_simulate, tasks, workers)


def _simulate(task: _Task) -> tuple[int, bytes]:
    seed, number, settings = task
    return number, format_motion(simulate_motion(seed, number, settings))


def motion_path(folder: Path, number: int) -> Path:
    """Return the file of an organ's motion."""
    return folder / f"{organ_name(number)}.npz"


def read_motion(folder: Path, number: int, plan: StreamPlan) -> MovingOrgan:
    """Read an organ's motion, and check that it is the plan's.

    Raises
    ------
    InvalidInputError
        It is not, or damaged.
    """
    path = motion_path(folder, number)
    motion = parse_motion(path.read_bytes(), str(path))
    # As JSON has it, which knows no tuples.
    wanted: dict[str, Any] = json.loads(
        json.dumps(
            {
                "seed": [plan.seed, number],
                "recipe": plan.motion.recipe.to_json(),
                "duration_s": plan.motion.duration_s,
                "states": plan.motion.states,
            }
        )
    )
    for name, value in wanted.items():
        if motion.about.get(name) != value:
            raise InvalidInputError(
                f"{path}: expected a motion with {name} {value}, got {motion.about.get(name)}; name another --out"
            )
    return motion


def _hash(motion: MovingOrgan) -> str:
    content = hashlib.sha256()
    for array in (
        motion.mesh.vertices,
        motion.mesh.tets,
        motion.mesh.faces,
        motion.attached,
        motion.times,
        motion.displacement,
    ):
        content.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
    return content.hexdigest()
