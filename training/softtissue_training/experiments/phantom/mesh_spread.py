"""How far answers of `elastic` depend on which tetrahedra fill the organ: the same observations on several meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.organ.organ import Organ, make_organ
from softtissue_estimator.organ.surface_patch import patch
from softtissue_estimator.organ.volume_mesh import VolumeMesh, tetrahedralise
from softtissue_training.evaluation.benchmark.machine import machine
from softtissue_training.experiments.coherent_point_drift import spread_points
from softtissue_training.experiments.phantom.case import PhantomCase
from softtissue_training.experiments.phantom.own_case import own_phantom_case

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

FEWEST_MESHES = 2
_PATCH_SHARE = 0.2  # of the surface, which each observation beside the recorded one sees
_SEED = 0  # of their noise


def measure(meshes: int, patches: int, progress: Progress) -> dict[str, Any]:
    """Answer observations of the bundled organ on freshly made meshes, and on the one that its folder names.

    Parameters
    ----------
    meshes : int
        How often the organ is filled anew, as one whose folder names no tetrahedra.
    patches : int
        Observations beside the recorded one (`observations_of`).
    progress : callable
        Told what is going on.

    Returns
    -------
    dict
        Per observation and of all together: `spread` at the structures' points, and the mean error on every mesh.
    """
    if meshes < FEWEST_MESHES:
        raise InvalidInputError(f"meshes: expected at least {FEWEST_MESHES}, got {meshes}")
    case = own_phantom_case()
    truth = true_displacement(case)
    observations = observations_of(case, patches)
    inner = slice(0, len(case.organ.structure_points))
    filled = [tetrahedralise(case.organ.surface, progress) for _ in range(meshes)]
    named = [] if case.organ.tetrahedra is None else [case.organ.tetrahedra]
    found = []
    for number, mesh in enumerate(filled + named, 1):
        progress(f"mesh {number} of {len(filled + named)}: {len(mesh.nodes)} nodes")
        found.append(answers(case.organ, mesh, observations, progress))
    means = np.stack([mean[:, inner] for mean, _ in found])
    sigmas = np.stack([sigma[:, inner] for _, sigma in found])
    error_mm = 1e3 * np.linalg.norm(means - truth[inner], axis=-1).mean(axis=-1)

    def row(which: slice) -> dict[str, Any]:
        errors = error_mm[:, which].mean(axis=1).round(3).tolist()
        fresh = {"error_mm": errors[:meshes], "error_named_mm": errors[meshes:]}
        return {**spread(means[:meshes, which], sigmas[:meshes, which]), **fresh}

    rows = {name: row(slice(i, i + 1)) for i, name in enumerate(observations)}
    nodes = [len(mesh.nodes) for mesh in filled + named]
    return {"machine": machine(), "nodes": nodes, "observations": {**rows, "all": row(slice(None))}}


def true_displacement(case: PhantomCase) -> FloatArray:
    """Return where the query points of a simulated case truly went, (q, 3) m."""
    if case.truth is None:
        raise InvalidInputError(f"{case.name}: expected a simulation, got a case without a truth")
    return np.asarray(case.truth.positions - case.organ.query_points)


def observations_of(case: PhantomCase, patches: int) -> dict[str, Observation]:
    """Return the recorded observation of a simulated case, and others of the same deformation.

    Those see a fifth of the surface around points that are spread over all of it, with the same noise.
    """
    if case.correspondences is None:
        raise InvalidInputError(f"{case.name}: expected correspondences, got none")
    observed = {"recorded": (case.correspondences.before, case.correspondences.after)}
    organ, rng = case.organ, np.random.default_rng(_SEED)
    vertices = organ.surface.vertices
    moved = vertices + true_displacement(case)[len(organ.structure_points) :]
    for number, middle in enumerate(spread_points(vertices, patches), 1):
        seen = patch(organ.surface, vertices[middle], _PATCH_SHARE)
        noise = rng.normal(scale=case.sigma_m, size=(int(seen.sum()), 3))
        observed[f"patch {number}"] = vertices[seen], moved[seen] + noise
    config = EstimatorConfig()
    return {
        name: make_observation(after, before, case.sigma_m, organ, config)[0]
        for name, (before, after) in observed.items()
    }


def answers(
    organ: Organ, mesh: VolumeMesh, observations: Mapping[str, Observation], progress: Progress
) -> tuple[FloatArray, FloatArray]:
    """Displacement (o, q, 3) m and sigma (o, q) m of the query points for each observation on its own."""
    estimator = ElasticEstimator(EstimatorConfig(tracking=False))
    estimator.load_organ(with_tetrahedra(organ, mesh), progress)
    found = [estimator.estimate(observation) for observation in observations.values()]
    displacement = np.stack([one.displacement for one in found])
    return displacement, np.stack([np.asarray(one.sigma) for one in found])


def with_tetrahedra(organ: Organ, mesh: VolumeMesh) -> Organ:
    """Return the same organ with other tetrahedra."""
    o = organ
    return make_organ(o.name, o.frame, o.surface, o.structures, o.attached, o.folder, o.system, mesh)


def spread(means: FloatArray, sigmas: FloatArray) -> dict[str, float]:
    """Compare what the mesh changes of an answer with its sigma.

    Parameters
    ----------
    means : (m, ..., 3) m
        Answers on m meshes.
    sigmas : (m, ...) m
        Their standard deviation of each component.

    Returns
    -------
    dict
        Root mean squares over points and components, mm: of the standard deviation over meshes, and of sigma; their
        ratio; and the share of points that the mesh moves by more than sigma, %.
    """
    variance = means.var(axis=0, ddof=1).mean(axis=-1)
    expected = np.square(sigmas).mean(axis=0)
    spread_mm, sigma_mm = (1e3 * float(np.sqrt(v.mean())) for v in (variance, expected))
    return {
        "spread_mm": spread_mm,
        "sigma_mm": sigma_mm,
        "ratio": spread_mm / sigma_mm,
        "beyond_sigma_percent": 100.0 * float((variance > expected).mean()),
    }


def table(summary: Mapping[str, Any]) -> str:
    """Return what `measure` found as Markdown."""
    lines = [
        "| observation | spread, mm | sigma, mm | ratio | beyond sigma | mean errors, mm | on the named mesh, mm |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in summary["observations"].items():
        errors = (", ".join(f"{e:.1f}" for e in row[key]) for key in ("error_mm", "error_named_mm"))
        lines.append(
            f"| {name} | {row['spread_mm']:.2f} | {row['sigma_mm']:.2f} | {row['ratio']:.2f} | "
            f"{row['beyond_sigma_percent']:.0f} % | {' | '.join(errors)} |"
        )
    return "\n".join([*lines, "", f"nodes: {', '.join(map(str, summary['nodes']))}"])
