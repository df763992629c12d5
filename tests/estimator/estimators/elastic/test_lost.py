"""An organ that leaves the view: no answer about what is seen instead, and found where it comes back."""

import dataclasses

import numpy as np
import pytest

from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import OrganNotFoundError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.organ.mesh import sample_faces

SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=2)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055, ellipsoid_tets((0.08, 0.05, 0.04)))
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0, tracking=True, tracking_patience_s=60.0)
TOP = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.01, 0.0025)[0]
CAMERA = np.array([0.0, 0.0, 0.3])
_GRID = np.arange(-0.06, 0.06, 0.002)
WALL = np.stack([*np.meshgrid(_GRID, _GRID), np.full((60, 60), 0.0)], axis=-1).reshape(-1, 3)


def bent(points, size):
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, 0.0 * lever, size * lever**2])


def cloud(points, stamp_s, viewpoint=CAMERA):
    noise = np.random.default_rng(int(100 * stamp_s)).normal(scale=0.0003, size=points.shape)
    return BareCloud(points + noise, np.full(len(points), 0.0003), viewpoint, stamp_s=stamp_s)


@pytest.fixture(scope="module")
def loaded():
    made = ElasticEstimator(CONFIG)
    made.load_organ(ORGAN)
    yield made
    made.close()


@pytest.fixture
def estimator(loaded):
    loaded.forget()
    return loaded


@pytest.mark.parametrize("height", [0.045, 0.06])
def test_a_wall_is_not_taken_for_the_organ_that_was_followed(estimator, height):
    organ = TOP + bent(TOP, 0.6)
    for frame in range(4):
        before = estimator.estimate_bare(cloud(organ, 1.0 + 0.2 * frame))
    for frame in range(3):
        with pytest.raises(OrganNotFoundError):
            estimator.estimate_bare(cloud(WALL + np.array([0.0, 0.0, height]), 3.0 + 0.2 * frame))
    after = estimator.estimate_bare(cloud(organ, 5.0))
    apart = np.linalg.norm(after.displacement - before.displacement, axis=1)
    assert apart.mean() < 0.0015
    assert after.diagnosis.doubts == before.diagnosis.doubts == ()


def test_remains_of_what_was_seen_are_not_the_organ(estimator):
    # All but a rim is cut out, and the rim has moved: an organ that may bend fits it anyhow.
    for frame in range(4):
        estimator.estimate_bare(cloud(TOP, 1.0 + 0.2 * frame))
    rim = TOP[TOP[:, 0] > 0.06] + [0.0, 0.0, 0.015]
    with pytest.raises(OrganNotFoundError, match=r"cells of 5 mm .* looked for|at least 10 cells"):
        estimator.estimate_bare(cloud(rim, 2.0))


def test_a_view_that_narrows_is_followed(estimator):
    for frame in range(12):
        narrow = TOP[TOP[:, 0] > -0.06 + 0.01 * frame]
        answer = estimator.estimate_bare(cloud(narrow, 1.0 + 0.1 * frame))
    assert len(narrow) < 0.15 * len(TOP)
    assert np.linalg.norm(answer.displacement, axis=1).mean() < 0.001


def test_a_first_cloud_that_shows_little_and_fits_nothing_is_refused(estimator):
    post = WALL[(np.abs(WALL[:, :2]) < 0.013).all(axis=1)] + [0.02, 0.0, 0.07]
    post[:, 2] += 0.6 * np.abs(post[:, 0] - 0.02)
    with pytest.raises(OrganNotFoundError):
        estimator.estimate_bare(cloud(post, 1.0))
    alone = ElasticEstimator(dataclasses.replace(CONFIG, tracking=False))
    alone.load_organ(ORGAN)
    with pytest.raises(OrganNotFoundError):
        alone.estimate_bare(cloud(post, 1.0))


def test_an_organ_that_is_elsewhere_when_it_comes_back_is_found(estimator):
    for frame in range(4):
        estimator.estimate_bare(cloud(TOP, 1.0 + 0.2 * frame))
    for frame in range(2):
        with pytest.raises(OrganNotFoundError):
            estimator.estimate_bare(cloud(WALL + np.array([0.0, 0.0, 0.06]), 2.0 + 0.2 * frame))
    moved = TOP + bent(TOP, 1.5)
    answered = []
    for frame in range(9):
        try:
            answered.append((frame, estimator.estimate_bare(cloud(moved, 3.0 + 0.2 * frame))))
        except OrganNotFoundError:
            continue
    assert answered[0][0] <= 5
    error = np.linalg.norm(answered[-1][1].displacement_at(TOP)[0] - bent(TOP, 1.5), axis=1)
    assert error.mean() < 0.5 * np.linalg.norm(bent(TOP, 1.5), axis=1).mean()
