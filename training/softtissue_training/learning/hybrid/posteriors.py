"""Run the elastic estimator over simulations and keep its posteriors, for the hybrid network to learn from."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.estimators.hybrid.input import HybridSpec
from softtissue_estimator.estimators.paper.network_input import PREPROCESSING_VERSION
from softtissue_estimator.support.cache import cache_folder
from softtissue_training.core_sources import imported_sources
from softtissue_training.learning.hybrid.posterior_case import posterior_case
from softtissue_training.learning.hybrid.posterior_record import (
    PosteriorCase,
    PosteriorRecord,
    format_posteriors,
)
from softtissue_training.learning.hybrid.views import ViewRecipe
from softtissue_training.simulation.archive import list_records, read_records, record_number, write_record
from softtissue_training.simulation.cluster import results_of
from softtissue_training.simulation.record_format import content_hash, parse_record
from softtissue_training.simulation.reserved_seeds import check_not_reserved

if TYPE_CHECKING:
    from distributed import Client

SETTINGS = "posterior.json"
MESH_CACHE = "tetrahedra-"  # how the estimator's cache names coarse meshes
_RECORD_VERSION = 1
# Imported by the estimator without changing what it answers.
_WITHOUT_INFLUENCE = frozenset(
    {"config", "errors", "estimators.estimator", "inference", "support"}
    | {
        f"organ.{name}"
        for name in ("mesh_files", "mesh_io", "organ", "organ_checks", "organ_file", "surface_repair")
    }
)
_ELASTIC_SETTINGS = (
    "poisson_ratio",
    "poisson_ratio_sigma",
    "prior_sigma_m",
    "model_sigma_m",
    "attachment_length_m",
    "registration_sigma_m",
    "registration_sigma_rad",
)
_Result = tuple[str, bytes, list[str], int]


@dataclass(frozen=True)
class PosteriorReport:
    """What a run of the command did.

    Attributes
    ----------
    organs
        Records in the folder.
    made, views
        Records that this run added, and views in them.
    seconds
        What that took.
    failures
        How often cases or views could not be used, for which reason.
    """

    organs: int
    made: int
    views: int
    seconds: float
    failures: dict[str, int]


def posterior_settings(recipe: ViewRecipe, spec: HybridSpec) -> dict[str, Any]:
    """Return all that stored posteriors depend on beside the simulations: views, grid, estimator and its code."""
    settings = asdict(EstimatorConfig())
    elastic = {name: settings[name] for name in _ELASTIC_SETTINGS}
    grid = {
        "spacing": spec.spacing,
        "margin_cells": spec.margin_cells,
        "multiple": spec.architecture.multiple,
        "preprocessing": PREPROCESSING_VERSION,
    }
    made: dict[str, Any] = json.loads(
        json.dumps(
            {
                "version": _RECORD_VERSION,
                "recipe": asdict(recipe),
                "grid": grid,
                "elastic": elastic,
                "code": elastic_code_hash(),
            }
        )
    )
    return made


def elastic_code_hash() -> str:
    """Return a hash of the sources that decide what the elastic estimator answers, and how it is read."""
    content = hashlib.sha256()
    for module, path in imported_sources(
        ["estimators.elastic.estimator", "estimators.hybrid.posterior"], _WITHOUT_INFLUENCE
    ).items():
        content.update(module.encode() + path.read_bytes())
    return content.hexdigest()[:16]


def make_posteriors(
    data: Path,
    out: Path,
    recipe: ViewRecipe,
    spec: HybridSpec,
    *,
    skip: int = 0,
    count: int | None = None,
    meshes: Path | None = None,
    client: Client | None = None,
    show_progress: bool = True,
) -> PosteriorReport:
    """Add to a folder the posteriors of those simulations that it lacks.

    Results travel back to this process, which alone writes them, each file as a whole: a run that is stopped or killed
    goes on with the same command.

    Parameters
    ----------
    data
        Folder or packed file of simulations.
    out
        Where to; made if needed.
    skip, count
        Leave out so many first records, and use at most so many.
    meshes
        Folder in which the organs' coarse meshes are kept and looked for, to save time; all processes must reach
        it.
    client
        Dask client; without one, this process computes.

    Raises
    ------
    InvalidInputError
        There are no simulations, or the folder holds posteriors that were made differently.
    """
    names = list_records(data)[skip : None if count is None else skip + count]
    if not names:
        raise InvalidInputError(f"{data}: expected simulations after the first {skip}, got none")
    settings = posterior_settings(recipe, spec)
    _claim(out, settings)
    present = {record_number(name) for name in list_records(out)}
    missing = [name for name in names if record_number(name) not in present]
    work = partial(_posteriors_of, recipe=recipe, spec=spec, settings=settings, meshes=meshes)
    tasks = zip(missing, read_records(data, missing), strict=True)
    failures: Counter[str] = Counter()
    views, start = 0, time.monotonic()
    results = map(work, tasks) if client is None else results_of(client, work, tasks)
    with tqdm(
        total=len(names),
        initial=len(names) - len(missing),
        unit="organ",
        desc="posteriors",
        disable=not show_progress,
    ) as bar:
        for name, content, reasons, made in results:
            write_record(out, name, content)
            failures.update(reasons)
            views += made
            bar.update()
    seconds = time.monotonic() - start
    return PosteriorReport(len(list_records(out)), len(missing), views, seconds, dict(failures))


def _claim(out: Path, settings: dict[str, Any]) -> None:
    """Note in a new folder what it is for; refuse one that is for something else."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / SETTINGS
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        changed = [name for name in settings if found.get(name) != settings[name]]
        if changed:
            raise InvalidInputError(
                f"{out}: expected posteriors made with the present settings and elastic estimator, got others "
                f"(different: {', '.join(changed)}); delete the folder or name another"
            )
        return
    partial_path = path.with_name(path.name + f".partial{os.getpid()}")
    partial_path.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
    partial_path.replace(path)


def _posteriors_of(
    task: tuple[str, bytes],
    recipe: ViewRecipe,
    spec: HybridSpec,
    settings: dict[str, Any],
    meshes: Path | None = None,
) -> _Result:
    name, content = task
    record = parse_record(content, name)
    check_not_reserved(record.seed[0])
    cases: list[PosteriorCase] = []
    failures: list[str] = []
    torch.set_num_threads(1)
    with _own_cache(None if meshes is None else meshes / Path(name).stem):
        for sample in record.simulations:
            rng = np.random.default_rng([recipe.seed, *record.seed, sample.case])
            try:
                cases.append(posterior_case(sample, recipe, spec, rng, failures.append))
            except SoftTissueError as error:
                failures.append(str(error))
    kept = PosteriorRecord(
        tuple(cases), settings, record.seed, content_hash(content, name), tuple(sorted(set(failures)))
    )
    views = sum(len(case.counts) for case in cases)
    return f"{Path(name).stem}.npz", format_posteriors(kept), failures, views


@contextmanager
def _own_cache(kept: Path | None) -> Iterator[None]:
    """Let what the estimator keeps of an organ go with it: thousands of organs do not belong in the user's cache.

    Parameters
    ----------
    kept
        Folder in which the coarse mesh stays; None for nowhere.
    """
    before = os.environ.get("XDG_CACHE_HOME")
    with tempfile.TemporaryDirectory(prefix="softtissue-posterior-") as folder:
        os.environ["XDG_CACHE_HOME"] = str(folder if kept is None else kept.absolute())
        try:
            yield
        finally:
            for path in [] if kept is None else cache_folder().glob("*"):
                if not path.name.startswith(MESH_CACHE):
                    path.unlink(missing_ok=True)
            if before is None:
                del os.environ["XDG_CACHE_HOME"]
            else:
                os.environ["XDG_CACHE_HOME"] = before
