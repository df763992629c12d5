"""The bundled network on simulated organs in other positions: its frame turns with them, and it has learned to."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.estimators.paper.estimator import PaperEstimator
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.support.resources import bundled_checkpoint
from softtissue_training.organs.surface_patch import draw_faces

CONFIG = EstimatorConfig(estimator="paper", device="cpu", precision="float32")
TURNS = Rotation.random(2, random_state=np.random.default_rng(1)).as_matrix()


@pytest.fixture(scope="module")
def estimator():
    return PaperEstimator(CONFIG)


def _observed(sample, seed):
    """What is seen of 30 % of an organ's surface: places and displacements, (k, 3) m."""
    patch = draw_faces(sample.surface, lambda _: 0.3, np.random.default_rng(seed))
    points, face, barycentric = sample_faces(sample.surface, patch, 0.004)
    corners = sample.displacement.astype(np.float64)[sample.surface.faces[face]]
    return points, np.einsum("ka,kac->kc", barycentric, corners)


def _answer(estimator, sample, turn, seed):
    """The answer for a turned organ at its vertices, turned back, (n, 3) m."""
    surface = SurfaceMesh(sample.surface.vertices @ turn.T, sample.surface.faces)
    estimator.load_organ(make_organ("organ", "organ", surface, (), sample.attached_mask, None))
    points, moved = _observed(sample, seed)
    observation = Observation(points @ turn.T, moved @ turn.T, np.full(len(points), 5e-4))
    return (
        estimator.estimate(observation).displacement_at(sample.vertices.astype(np.float64) @ turn.T)[0] @ turn
    )


def test_turning_organ_and_observation_changes_the_answer_by_less_than_half_the_error(samples, estimator):
    apart_mm, moved_mm = [], []
    for number, sample in enumerate(samples[:3]):
        answer = _answer(estimator, sample, np.eye(3), number)
        moved_mm.append(1e3 * np.linalg.norm(answer, axis=1).mean())
        for turn in TURNS:
            turned = _answer(estimator, sample, turn, number)
            apart_mm.append(1e3 * np.linalg.norm(turned - answer, axis=1).mean())
    print("mean differences (mm):", np.round(apart_mm, 2), "mean displacements (mm):", np.round(moved_mm, 1))
    limit_mm = 0.5 * load_checkpoint(bundled_checkpoint()).provenance["validation_error_mm"]
    assert np.mean(moved_mm) > 5.0 * limit_mm
    assert 0.0 < np.mean(apart_mm) < limit_mm
