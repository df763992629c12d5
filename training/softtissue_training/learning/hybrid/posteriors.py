"""Run the elastic estimator over simulations and keep its posteriors, for the hybrid network to learn from."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

import softtissue_estimator
from softtissue_estimator.cache import cache_folder
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.elastic_estimator import ElasticEstimator
from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.hybrid_input import HybridSpec, hybrid_grid, posterior_cells
from softtissue_estimator.hybrid_posterior import PosteriorReader, make_reader
from softtissue_estimator.network_input import PREPROCESSING_VERSION, channels_on_grid
from softtissue_estimator.organ import make_organ
from softtissue_training.learning.hybrid.posterior_record import (
    PosteriorCase,
    PosteriorRecord,
    format_posteriors,
)
from softtissue_training.learning.hybrid.views import View, ViewRecipe, draw_attachment, draw_view
from softtissue_training.simulation.archive import list_records, read_records, record_number, write_record
from softtissue_training.simulation.cluster import results_of
from softtissue_training.simulation.record_format import content_hash, parse_record
from softtissue_training.simulation.reserved_seeds import check_not_reserved
from softtissue_training.simulation.sample import Sample

if TYPE_CHECKING:
    from distributed import Client

SETTINGS = "posterior.json"
MESH_CACHE = "tetrahedra-"  # how the estimator's cache names coarse meshes
_VERSION = 1
# What an estimate depends on; parameters of the node and of networks are not among it.
_SOURCES = (
    "elastic*.py",
    "volume_mesh.py",
    "rigid.py",
    "surface_lookup.py",
    "observation.py",
    "mesh.py",
    "hybrid_posterior.py",
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
    elastic = {name: settings[name] for name in ("poisson_ratio", "prior_sigma_m", "model_sigma_m")}
    grid = {
        "spacing": spec.spacing,
        "margin_cells": spec.margin_cells,
        "multiple": spec.architecture.multiple,
        "preprocessing": PREPROCESSING_VERSION,
    }
    made: dict[str, Any] = json.loads(
        json.dumps(
            {
                "version": _VERSION,
                "recipe": asdict(recipe),
                "grid": grid,
                "elastic": elastic,
                "code": elastic_code_hash(),
            }
        )
    )
    return made


def elastic_code_hash() -> str:
    """Return a hash of the sources that decide what the elastic estimator answers."""
    folder = Path(softtissue_estimator.__file__).parent
    content = hashlib.sha256()
    for pattern in _SOURCES:
        for path in sorted(folder.glob(pattern)):
            content.update(path.name.encode() + path.read_bytes())
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
        Folder in which the organs' coarse meshes are kept and looked for, half of the work; all processes must reach
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


def posterior_case(
    sample: Sample,
    recipe: ViewRecipe,
    spec: HybridSpec,
    rng: np.random.Generator,
    failed: Callable[[str], None],
) -> PosteriorCase:
    """Show a simulation to the elastic estimator in many views.

    Parameters
    ----------
    failed
        Told why, for each view that cannot be used.

    Raises
    ------
    SoftTissueError
        The organ cannot be used, or none of the views.
    """
    surface = sample.surface
    told = draw_attachment(surface, sample.attached_mask, recipe, rng)
    organ = make_organ("organ", "organ", surface, (), told)
    points, truth = sample.vertices.astype(np.float64), sample.displacement.astype(np.float64)
    estimator = ElasticEstimator(EstimatorConfig())
    estimator.load_organ(organ)
    grid = hybrid_grid(surface, spec)
    channels = channels_on_grid(grid, surface, told)
    distance = channels.signed_distance.half()
    cells = grid.points()[posterior_cells(distance.float(), grid.spacing).numpy()]
    reader = make_reader(estimator, organ.surface_lookup, cells)
    nodes = reader.mesh.nodes
    at_nodes = estimator.interpolation(nodes)
    kept: list[dict[str, Any]] = []
    for _ in range(recipe.views):
        try:
            view = draw_view(organ, truth[: len(surface.vertices)], recipe, rng)
            estimate = estimator.estimate(view.observation)
        except InvalidInputError as error:
            failed(str(error))
            continue
        displacement, sigma = estimate.interpolated(nodes, at_nodes)
        kept.append(
            {"displacement": displacement, "sigma": sigma} | _seen(view, reader, estimate, len(points))
        )
    if not kept:
        raise InvalidInputError("posteriors: expected at least one view that can be used, got none")
    return PosteriorCase(
        origin=np.array(grid.origin),
        shape=np.array(grid.shape),
        signed_distance=distance.numpy(),
        attached=channels.zero_displacement.bool().numpy(),
        nodes=nodes.astype(np.float32),
        tets=reader.mesh.tets.astype(np.int32),
        cell_tet=reader.mesh.locate(cells).astype(np.int32),
        points=sample.vertices,
        truth=sample.displacement,
        point_tet=reader.mesh.locate(points).astype(np.int32),
        displacement=np.stack([view["displacement"] for view in kept]).astype(np.float32),
        sigma=np.stack([view["sigma"] for view in kept]).astype(np.float16),
        visible=np.stack([view["visible"] for view in kept]),
        share=np.array([view["share"] for view in kept], dtype=np.float32),
        noise=np.array([view["noise"] for view in kept], dtype=np.float32),
        counts=np.array([len(view["reference"]) for view in kept], dtype=np.int64),
        reference=np.concatenate([view["reference"] for view in kept]).astype(np.float32),
        misfit=np.concatenate([view["misfit"] for view in kept]).astype(np.float16),
        seen_sigma=np.concatenate([view["seen_sigma"] for view in kept]).astype(np.float16),
    )


def _seen(view: View, reader: PosteriorReader, estimate: Any, points: int) -> dict[str, Any]:
    misfit = reader.misfit(estimate)
    visible: NDArray[np.bool_] = np.zeros(points, dtype=bool)
    visible[: len(view.visible)] = view.visible
    return {
        "visible": visible,
        "share": view.share,
        "noise": view.noise_m,
        "reference": misfit.reference.numpy(),
        "misfit": misfit.misfit.numpy(),
        "seen_sigma": misfit.sigma.numpy(),
    }


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
