"""The benchmark's simulations on disk: made once, gone on with after an interruption."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.benchmark.plan import DataSet, NamedSurface, Plan
from softtissue_training.organs.named_surface import organ_from_file
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.simulation.archive import list_records, record_name
from softtissue_training.simulation.cluster import connect
from softtissue_training.simulation.generate import generate

if TYPE_CHECKING:
    from distributed import Client

_MESH = "organ.mesh.npz"


def make_simulations(plan: Plan, folder: Path, *, workers: int, show_progress: bool = True) -> None:
    """Simulate what is missing of a plan's data sets, each in a folder of its own.

    Parameters
    ----------
    folder
        Of all data sets.
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        A surface cannot be used, or a folder holds other simulations.
    """
    meshes = {data.name: _organ(data.surface, folder / data.name) for data in plan.data_sets}
    complete = all(_is_complete(data, folder) for data in plan.data_sets)
    with _client(0 if complete else workers) as client:
        for data in plan.data_sets:
            if show_progress and not complete:
                print(f"simulating: {data.name}", flush=True)
            generate(
                folder / data.name,
                data.organs,
                data.seed,
                data.recipe,
                mesh=meshes[data.name],
                materials=tuple(material for _, material in data.materials),
                client=client,
                show_progress=show_progress and not complete,
            )


def _is_complete(data: DataSet, folder: Path) -> bool:
    place = folder / data.name
    return place.is_dir() and {record_name(i) for i in range(data.organs)} <= set(list_records(place))


@contextmanager
def _client(workers: int) -> Iterator[Client | None]:
    if workers == 0:
        yield None
        return
    with connect(workers) as client:
        yield client


def _organ(surface: NamedSurface | None, folder: Path) -> TetMesh | None:
    """Fill a surface with tetrahedra, once: the mesh is kept beside the simulations."""
    if surface is None:
        return None
    if not surface.path.is_file():
        raise InvalidInputError(f"surface: expected a file, got {surface.path}, which does not exist")
    content = hashlib.sha256(surface.path.read_bytes() + repr(surface.unit_m).encode()).hexdigest()
    path = folder / _MESH
    if path.is_file():
        with np.load(path) as stored:
            if str(stored["surface"]) != content:
                raise InvalidInputError(
                    f"{folder}: expected simulations of {surface.path}, got those of another surface or unit; "
                    "name another --out"
                )
            return TetMesh(stored["vertices"], stored["tets"], stored["faces"])
    mesh = organ_from_file(surface.path, surface.unit_m)
    folder.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial{os.getpid()}.npz")
    np.savez_compressed(partial, surface=content, vertices=mesh.vertices, tets=mesh.tets, faces=mesh.faces)
    partial.replace(path)
    return mesh
