"""Observations of a simulation: many views of one organ, as different as those of a camera in use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, sample_faces
from softtissue_estimator.organ.organ import Organ
from softtissue_training.organs.surface_patch import draw_faces, resized

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_SMALLEST_SIGMA_M = 0.0002  # what estimators are told where there is no noise


@dataclass(frozen=True)
class ViewRecipe:
    """How views are drawn.

    Attributes
    ----------
    views
        Views of each load case.
    seed
        Views depend on it and on the record alone.
    visible_share
        Lowest and highest visible share of the surface. Half of the views draw it on a logarithmic scale, so that small
        patches are not rare, the others evenly from `common_share`.
    common_share
        See there.
    noise_m
        Lowest and highest standard deviation of the noise on each component of an observed displacement, metres.
    noisy
        Share of the views with noise.
    sparse
        Share of the views of which only a few points are known.
    sparse_points
        Lowest and highest number of these, drawn on a logarithmic scale.
    misattached
        Share of the load cases whose attached region the estimator is told wrongly.
    misattachment
        By how much of its area, in either direction.
    spacing_m
        Largest distance of neighbouring observed points, metres.
    """

    views: int = 4
    seed: int = 1
    visible_share: tuple[float, float] = (0.02, 1.0)
    common_share: tuple[float, float] = (0.08, 0.6)
    noise_m: tuple[float, float] = (0.0, 0.003)
    noisy: float = 0.5
    sparse: float = 0.15
    sparse_points: tuple[int, int] = (8, 40)
    misattached: float = 0.25
    misattachment: float = 0.3
    spacing_m: float = 0.003

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InvalidInputError(f"views of each load case: expected at least 1, got {self.views}")

    def draw_share(self, rng: np.random.Generator) -> float:
        """Draw the visible share of one view."""
        if rng.random() < 0.5:
            return float(np.exp(rng.uniform(*np.log(self.visible_share))))
        return float(rng.uniform(*self.common_share))


@dataclass(frozen=True, eq=False)
class View:
    """One view.

    Attributes
    ----------
    observation
        What an estimator is shown.
    visible
        (v,) true for vertices of visible faces.
    share
        Visible share of the surface's area.
    noise_m
        Standard deviation of the noise, metres.
    """

    observation: Observation
    visible: BoolArray
    share: float
    noise_m: float


def draw_attachment(
    surface: SurfaceMesh, attached: BoolArray, recipe: ViewRecipe, rng: np.random.Generator
) -> BoolArray:
    """Draw which vertices an estimator is told to be attached, (v,)."""
    wrong, grows = rng.random() < recipe.misattached, rng.random() < 0.5
    if not wrong:
        return attached
    return resized(surface, attached, 1.0 + (recipe.misattachment if grows else -recipe.misattachment))


def draw_view(organ: Organ, displacement: FloatArray, recipe: ViewRecipe, rng: np.random.Generator) -> View:
    """Draw a patch that grows along the surface from a random point, and what is known of it.

    Parameters
    ----------
    displacement
        (v, 3) m of the surface's vertices; linear within each face.

    Raises
    ------
    InvalidInputError
        Too few points are observed for any estimator.
    """
    surface, areas = organ.surface, face_areas(organ.surface)
    faces = draw_faces(surface, recipe.draw_share, rng)
    points, face, weights = sample_faces(surface, faces, recipe.spacing_m)
    moved = np.einsum("ka,kac->kc", weights, displacement[surface.faces[face]])
    if rng.random() < recipe.sparse:
        count = min(len(points), round(float(np.exp(rng.uniform(*np.log(recipe.sparse_points))))))
        chosen = rng.choice(len(points), count, replace=False)
        points, moved = points[chosen], moved[chosen]
    noise_m = float(rng.uniform(*recipe.noise_m)) if rng.random() < recipe.noisy else 0.0
    moved = moved + noise_m * rng.normal(size=moved.shape)
    sigma = max(noise_m, _SMALLEST_SIGMA_M)
    observation, _ = make_observation(points + moved, points, sigma, organ, EstimatorConfig())
    visible = np.zeros(len(surface.vertices), dtype=bool)
    visible[surface.faces[faces]] = True
    return View(observation, visible, float(areas[faces].sum() / areas.sum()), noise_m)
