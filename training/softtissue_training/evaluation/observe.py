"""Draw what a camera would see of a simulated organ (paper, section "Training data": u_vis on a random patch)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, sample_faces, sum_by_index
from softtissue_estimator.organ.organ import Organ, make_organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_training.evaluation.case import EvaluationCase, depth_below
from softtissue_training.organs.surface_patch import draw_faces, resized
from softtissue_training.simulation.sample import Sample

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

SMALLEST_SIGMA_M = 0.0002
"""Standard deviation that estimators are told where no noise is added."""
OUTLIER_ERROR_M = (0.03, 0.08)
"""How far outliers are off, in any direction."""


@dataclass(frozen=True)
class ObservationSettings:
    """What is observed, and how well.

    Attributes
    ----------
    visible_share
        Lowest and highest share of the surface's area that is visible; drawn evenly between them.
    noise_m
        Standard deviation of the Gaussian noise on each component of each observed displacement, m.
    spacing_m
        Distance of neighbouring observed points, m; zero observes the vertices of the visible faces instead.
    sparse
        Keep only this many of the observed points, drawn at random; None keeps all.
    outliers
        Share of the observed points that are grossly wrong, by `OUTLIER_ERROR_M`; estimators are not told.
    attached_share
        Area of the attached region that estimators are told, over that of the true one.
    """

    visible_share: tuple[float, float] = (0.08, 0.60)
    noise_m: float = 0.0
    spacing_m: float = 0.003
    sparse: int | None = None
    outliers: float = 0.0
    attached_share: float = 1.0

    def __post_init__(self) -> None:
        low, high = self.visible_share
        if not 0.0 < low <= high <= 1.0:
            raise InvalidInputError(
                "visible surface: expected two shares in ascending order above 0 and up to 100 %, "
                f"got {100 * low:g} % and {100 * high:g} %"
            )
        if not 0.0 <= self.noise_m <= 0.1:
            raise InvalidInputError(f"noise: expected 0 to 100 mm, got {1e3 * self.noise_m:g} mm")
        if not (self.spacing_m == 0.0 or 0.0005 <= self.spacing_m <= 0.1):
            raise InvalidInputError(
                f"spacing of observed points: expected 0.5 to 100 mm, or 0 for the vertices, "
                f"got {1e3 * self.spacing_m:g} mm"
            )
        if self.sparse is not None and self.sparse < 3:
            raise InvalidInputError(f"observed points: expected at least 3, got {self.sparse}")
        if not 0.0 <= self.outliers < 1.0:
            raise InvalidInputError(f"outliers: expected 0 to below 100 %, got {100 * self.outliers:g} %")
        if not 0.1 <= self.attached_share <= 10.0:
            raise InvalidInputError(
                f"attached region: expected 0.1 to 10 times the true area, got {self.attached_share:g}"
            )

    def draw_share(self, rng: np.random.Generator) -> float:
        """Draw the visible share."""
        return rng.uniform(*self.visible_share)


def told_organ(sample: Sample, settings: ObservationSettings, name: str) -> Organ:
    """Return what estimators are told of a simulation's organ.

    The order in which a record lists its triangles, which packing may change, does not matter.
    """
    surface = SurfaceMesh(sample.surface.vertices, ordered_faces(sample.surface.faces))
    attached = sample.attached_mask
    if settings.attached_share != 1.0:
        attached = resized(surface, attached, settings.attached_share)
    return make_organ(name, "organ", surface, (), attached)


def simulated_case(
    sample: Sample,
    settings: ObservationSettings,
    rng: np.random.Generator,
    name: str,
    organ: Organ | None = None,
) -> EvaluationCase:
    """Make a case of a simulation: one random visible patch, observed as the settings say.

    All randomness is drawn in one order (patch, points, noise, outliers), so that the same generator with more noise
    observes the same patch.

    Parameters
    ----------
    organ
        What `told_organ` returned for this organ and attachment, to save its tables for finding points.
    """
    organ = organ or told_organ(sample, settings, name)
    surface = organ.surface
    nodes = sample.vertices.astype(np.float64)
    truth = sample.displacement.astype(np.float64)
    faces = draw_faces(surface, settings.draw_share, rng)
    visible = np.zeros(len(nodes), dtype=bool)
    visible[surface.faces[faces]] = True
    areas = face_areas(surface)
    return EvaluationCase(
        name=name,
        organ=organ,
        observation=observe(organ, faces, truth[: len(surface.vertices)], settings, rng),
        points=nodes,
        truth=truth,
        visible=visible,
        depth=depth_below(nodes, surface, faces),
        visible_share=float(areas[faces].sum() / areas.sum()),
        load_seen_share=load_seen_share(sample, visible),
        volume=VolumeMesh(nodes, sample.tets.astype(np.int64)),
    )


def ordered_faces(faces: IntArray) -> IntArray:
    """Return the same triangles (m, 3), each from its lowest vertex on and sorted, with their orientation kept."""
    first = faces.argmin(axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def observe(
    organ: Organ,
    visible_faces: BoolArray,
    displacement: FloatArray,
    settings: ObservationSettings,
    rng: np.random.Generator,
) -> Observation:
    """Observe the visible faces of an organ, through the checks that the node makes too.

    Parameters
    ----------
    displacement
        (n, 3) m of the surface's vertices; linear within each face.
    """
    surface = organ.surface
    if settings.spacing_m > 0.0:
        points, face, weights = sample_faces(surface, visible_faces, settings.spacing_m)
        moved = np.einsum("ka,kac->kc", weights, displacement[surface.faces[face]])
    else:
        vertices = np.unique(surface.faces[visible_faces])
        points, moved = surface.vertices[vertices], displacement[vertices]
    if settings.sparse is not None:
        chosen = rng.choice(len(points), size=min(settings.sparse, len(points)), replace=False)
        points, moved = points[chosen], moved[chosen]
    moved = moved + settings.noise_m * rng.normal(size=moved.shape)
    if settings.outliers > 0.0:
        moved = _with_outliers(moved, settings.outliers, rng)
    sigma = max(settings.noise_m, SMALLEST_SIGMA_M)
    return make_observation(points + moved, points, sigma, organ, EstimatorConfig())[0]


def _with_outliers(moved: FloatArray, share: float, rng: np.random.Generator) -> FloatArray:
    """Return displacements (n, 3) m of which a share, drawn at random, is off by centimetres."""
    wrong = rng.choice(len(moved), size=round(share * len(moved)), replace=False)
    direction = rng.normal(size=(len(wrong), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    result = moved.copy()
    result[wrong] += direction * rng.uniform(*OUTLIER_ERROR_M, size=(len(wrong), 1))
    return result


def load_seen_share(sample: Sample, visible: BoolArray) -> float | None:
    """Return the share of the surface's load that acts on visible vertices; None without any load on the surface.

    Counted is the length of each vertex's force, pressure times area included. What acts on attached vertices moves
    nothing and does not count; nor does gravity, which acts everywhere.
    """
    count = sample.surface_count
    strength = np.linalg.norm(sample.force[:count].astype(np.float64), axis=1)
    pressed = sample.pressure.astype(np.float64) * face_areas(sample.surface) / 3.0
    strength += sum_by_index(sample.surface.faces.ravel(), np.repeat(pressed, 3), count)
    strength[sample.attached] = 0.0
    total = float(strength.sum())
    return float(strength[visible[:count]].sum()) / total if total > 0.0 else None
