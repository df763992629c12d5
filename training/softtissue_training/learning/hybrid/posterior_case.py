"""Show one simulation to the elastic estimator in many views, and keep what it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.estimate import ElasticEstimate
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.hybrid.input import HybridSpec, hybrid_grid, posterior_cells
from softtissue_estimator.estimators.hybrid.posterior import observed_misfit
from softtissue_estimator.estimators.paper.network_input import channels_on_grid
from softtissue_estimator.organ.organ import make_organ
from softtissue_training.learning.hybrid.posterior_record import PosteriorCase
from softtissue_training.learning.hybrid.views import View, ViewRecipe, draw_attachment, draw_view
from softtissue_training.simulation.sample import Sample


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
    mesh = estimator.mesh
    nodes = mesh.nodes
    at_nodes = csr_array(eye_array(len(nodes)))
    kept: list[dict[str, Any]] = []
    for _ in range(recipe.views):
        try:
            view = draw_view(organ, truth[: len(surface.vertices)], recipe, rng)
            estimate = estimator.estimate(view.observation)
        except InvalidInputError as error:
            failed(str(error))
            continue
        displacement, sigma = estimate.interpolated(nodes, at_nodes)
        kept.append({"displacement": displacement, "sigma": sigma} | _observed(view, estimate, len(points)))
    if not kept:
        raise InvalidInputError("posteriors: expected at least one view that can be used, got none")
    return PosteriorCase(
        origin=np.array(grid.origin),
        shape=np.array(grid.shape),
        signed_distance=distance.numpy(),
        attached=channels.zero_displacement.bool().numpy(),
        nodes=nodes.astype(np.float32),
        tets=mesh.tets.astype(np.int32),
        cell_tet=mesh.locate(cells).astype(np.int32),
        points=sample.vertices,
        truth=sample.displacement,
        point_tet=mesh.locate(points).astype(np.int32),
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


def _observed(view: View, estimate: ElasticEstimate, points: int) -> dict[str, Any]:
    misfit = observed_misfit(estimate)
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
