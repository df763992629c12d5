"""The suite's organs and views on disk: made once, gone on with after an interruption."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_training.core_sources import core_sources
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.views import CloudView, view_of
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.phantom.pose import Pose
from softtissue_training.simulation.sample import Sample
from softtissue_training.simulation.simulate import simulate

FloatArray = NDArray[np.float64]

STORE_VERSION = 2
_ANEW = 1000
"""Between the numbers of an organ's draws."""


@dataclass(frozen=True, eq=False)
class SeenOrgan:
    """A deformed organ and clouds of it.

    Attributes
    ----------
    surface
        At rest, organ's frame, m.
    attached
        (n,) true for vertices that do not move.
    volume
        Tetrahedra of the simulation, whose first nodes are the surface's vertices.
    moved
        (k, 3) m, displacement of all nodes.
    views
        What a camera sees of it.
    """

    surface: SurfaceMesh
    attached: NDArray[np.bool_]
    volume: VolumeMesh
    moved: FloatArray
    views: tuple[CloudView, ...]

    @property
    def displacement(self) -> FloatArray:
        """(n, 3) m, displacement of the surface's vertices."""
        return self.moved[: len(self.surface.vertices)]


def make_organs(plan: CloudPlan, folder: Path, *, workers: int, show_progress: bool = True) -> None:
    """Simulate and look at the organs that a folder lacks, one file each.

    Parameters
    ----------
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        An organ cannot be seen as the plan asks.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [(plan, number, folder) for number in range(plan.organs) if not _path(folder, number).is_file()]
    with (
        environment(ONE_THREAD),
        tqdm(total=len(tasks), unit="organ", desc="simulating views", disable=not show_progress) as bar,
    ):
        for _ in _made(tasks, workers):
            bar.update()


def read_organ(plan: CloudPlan, folder: Path, number: int) -> SeenOrgan:
    """Read what `make_organs` wrote, and check that it is the plan's.

    Raises
    ------
    InvalidInputError
        It is not, or damaged.
    """
    path = _path(folder, number)
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["about"]) != about(plan, number):
                raise InvalidInputError(
                    f"{path}: expected views of the plan at hand, got others; name another --out"
                )
            views = tuple(
                CloudView(
                    stored[f"points{k}"].astype(np.float64),
                    stored[f"label{k}"],
                    Pose(stored["rotation"][k], stored["position"][k]),
                    stored["visible"][k],
                    float(stored["share"][k]),
                )
                for k in range(plan.views)
            )
            volume = VolumeMesh(stored["nodes"], stored["tets"])
            surface = SurfaceMesh(volume.nodes[: len(stored["attached"])], stored["faces"])
            return SeenOrgan(surface, stored["attached"], volume, stored["moved"], views)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{path} must be complete, got: {error}") from error


def result_key(plan: CloudPlan, number: int, *what: str) -> str:
    """Return a hash for results: of an organ with its views, of the estimator's code, and of further words."""
    content = "\0".join([about(plan, number), _core_digest(), *what])
    return hashlib.sha256(content.encode()).hexdigest()[:24]


@cache
def _core_digest() -> str:
    content = hashlib.sha256()
    for path in core_sources():
        content.update(path.read_bytes())
    return content.hexdigest()


def _made(tasks: list[tuple[CloudPlan, int, Path]], workers: int) -> Iterator[None]:
    return map(_make, tasks) if workers == 0 or not tasks else in_processes(_make, tasks, workers)


def _make(task: tuple[CloudPlan, int, Path]) -> None:
    plan, number, folder = task
    sample = _sample(plan, number)
    views = [
        view_of(sample, np.random.default_rng([plan.seed, number, k]), plan.limits) for k in range(plan.views)
    ]
    arrays = {f"points{k}": view.points.astype(np.float32) for k, view in enumerate(views)}
    labels = {f"label{k}": view.label for k, view in enumerate(views)}
    path = _path(folder, number)
    partial = path.with_name(f"{path.name}.partial{os.getpid()}.npz")
    np.savez_compressed(
        partial,
        about=np.array(about(plan, number)),
        nodes=sample.vertices.astype(np.float64),
        tets=sample.tets.astype(np.int64),
        faces=sample.surface.faces,
        attached=sample.attached_mask,
        moved=sample.displacement.astype(np.float64),
        rotation=np.stack([view.camera.rotation for view in views]),
        position=np.stack([view.camera.position for view in views]),
        visible=np.stack([view.visible for view in views]),
        share=np.array([view.visible_share for view in views]),
        allow_pickle=False,
        **arrays,
        **labels,
    )
    partial.replace(path)


def _sample(plan: CloudPlan, number: int) -> Sample:
    """Simulate organs until one is displaced as the plan asks."""
    low, high = plan.mean_displacement_m
    for draw in count():
        sample = simulate(plan.seed, number + _ANEW * draw, plan.recipe).simulations[0]
        moved = np.linalg.norm(sample.displacement[: sample.surface_count], axis=1).mean()
        if low <= moved <= high:
            return sample
    raise AssertionError("count() does not end")


def _path(folder: Path, number: int) -> Path:
    return folder / f"organ_{number:06d}.npz"


def about(plan: CloudPlan, number: int) -> str:
    """Say what an organ and its views depend on."""
    described = {"version": STORE_VERSION, "number": number} | asdict(plan)
    # How many there are, and how many of its views estimators are shown, changes none of them.
    del described["organs"], described["asked"]
    return json.dumps(described, sort_keys=True)
