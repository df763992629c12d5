"""Many simulations at once, on a Dask cluster; interrupted runs go on where they stopped."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.physics.material import Material
from softtissue_training.simulation.archive import (
    list_records,
    read_records,
    record_name,
    record_number,
    write_record,
)
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.record_format import format_record, parse_record
from softtissue_training.simulation.sample import Record
from softtissue_training.simulation.simulate import simulate

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class GenerationReport:
    """What a folder of simulations holds and what it took.

    Attributes
    ----------
    organs, simulations
        Records in the folder, and load cases in them.
    rejected
        How many draws were rejected for which reason, over all records.
    made
        Simulations that this run added.
    seconds
        What that took.
    """

    organs: int
    simulations: int
    rejected: dict[str, int]
    made: int
    seconds: float


def generate(
    folder: Path,
    organs: int,
    seed: int,
    recipe: Recipe | None = None,
    *,
    mesh: TetMesh | None = None,
    materials: tuple[Material, ...] = (),
    client: Client | None = None,
    show_progress: bool = True,
) -> GenerationReport:
    """Simulate those of the organs 0 to `organs` - 1 that a folder lacks.

    Records travel back to this process, which alone writes them, so that workers need no common file system and a
    worker that dies leaves nothing behind: its organs are given to another.

    Parameters
    ----------
    folder
        Where the records go; made if needed.
    seed
        Seed of the data set; organ i depends on `seed`, i and the recipe alone.
    recipe
        What to simulate; the paper's if None.
    mesh, materials
        As in `simulate`: one organ for all records, and materials that all loads are simulated with.
    client
        Dask client; without one, this process simulates.

    Raises
    ------
    InvalidInputError
        The folder holds simulations of another seed, recipe, organ or of other materials.
    """
    recipe = recipe or Recipe()
    make = partial(_simulate_one, seed, recipe=recipe, mesh=mesh, materials=materials)
    folder.mkdir(parents=True, exist_ok=True)
    present = {record_number(name) for name in list_records(folder)}
    rejected = _take_stock(folder, seed, recipe, mesh, materials)
    missing = [number for number in range(organs) if number not in present]
    start = time.monotonic()
    results = map(make, missing) if client is None else _results_of(client, make, missing)
    with tqdm(
        total=organs,
        initial=organs - len(missing),
        unit="organ",
        disable=not show_progress,
        desc="simulating",
    ) as bar:
        for number, content, reasons in results:
            write_record(folder, record_name(number), content)
            rejected.update(reasons)
            bar.update()
            bar.set_postfix(rejected=sum(rejected.values()), refresh=False)
    count, each = len(list_records(folder)), recipe.load_cases * max(1, len(materials))
    return GenerationReport(
        organs=count,
        simulations=count * each,
        rejected=dict(rejected),
        made=len(missing) * each,
        seconds=time.monotonic() - start,
    )


def _take_stock(
    folder: Path, seed: int, recipe: Recipe, mesh: TetMesh | None, materials: tuple[Material, ...]
) -> Counter[str]:
    """Count the rejections of what a folder holds already, and refuse to mix data sets."""
    rejected: Counter[str] = Counter()
    names = list_records(folder)
    for name, content in zip(names, read_records(folder, names), strict=True):
        record = parse_record(content, str(folder / name))
        if record.seed[0] != seed or record.recipe != recipe:
            raise InvalidInputError(
                f"{folder} must hold simulations of seed {seed} and the settings asked for, got {name} of seed "
                f"{record.seed[0]} and {_differences(record.recipe, recipe) or 'the same settings'}"
            )
        if not _is_of(record, mesh, materials):
            raise InvalidInputError(
                f"{folder} must hold simulations of the organ and the materials asked for, got {name} of others"
            )
        rejected.update(record.rejected)
    return rejected


def _is_of(record: Record, mesh: TetMesh | None, materials: tuple[Material, ...]) -> bool:
    first = record.simulations[0]
    if mesh is not None and not np.array_equal(first.vertices, mesh.vertices.astype(np.float32)):
        return False
    found = tuple(sample.material for sample in record.simulations)
    return (
        found == materials * record.recipe.load_cases if materials else len(found) == record.recipe.load_cases
    )


def _differences(found: Recipe, wanted: Recipe) -> str:
    ours, theirs = wanted.to_json(), found.to_json()
    return ", ".join(f"{name} {theirs[name]}" for name in ours if ours[name] != theirs[name])


_Result = tuple[int, bytes, dict[str, int]]


def _results_of(client: Client, make: Callable[[int], _Result], numbers: list[int]) -> Iterator[_Result]:
    # Dask is slow to import, and not needed without a cluster.
    from softtissue_training.simulation.cluster import results_of

    return results_of(client, make, numbers)


def _simulate_one(
    seed: int,
    number: int,
    recipe: Recipe,
    mesh: TetMesh | None = None,
    materials: tuple[Material, ...] = (),
) -> _Result:
    record = simulate(seed, number, recipe, mesh=mesh, materials=materials)
    return number, format_record(record), record.rejected
