"""An estimator of a user's own: registered by name, it reads the elastic posterior on a grid and adds to it."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators import estimator as registry
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.estimator import (
    Estimate,
    Estimator,
    create_estimator,
    register_estimator,
    silent,
)
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.observation.bare_cloud import make_bare_cloud
from softtissue_estimator.observation.bending_organ import BendingOrgan
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_organ

SIGMA_M = 0.001


class Corrected(Estimate):
    """A posterior and a field on a grid, (X, Y, Z, 3) m, that is added to its mean."""

    def __init__(self, elastic, grid, field, query):
        axes = [grid.origin[axis] + grid.spacing * np.arange(grid.shape[axis]) for axis in range(3)]
        self._elastic, self._field = elastic, RegularGridInterpolator(axes, field)
        self.stages, self.diagnosis, self.seen = elastic.stages, elastic.diagnosis, elastic.seen
        self.displacement, self.sigma = self.displacement_at(query)

    def displacement_at(self, points):
        mean, sigma = self._elastic.displacement_at(points)
        return mean + self._field(points), sigma


class PosteriorOnGrid(Estimator):
    """What a network that corrects the posterior would be: its input is read on a grid, its output added."""

    name, device = "mine", "cpu"

    def __init__(self, config):
        self._elastic = ElasticEstimator(config)
        self.read = None

    def load_organ(self, organ, progress=silent):
        self._elastic.load_organ(organ, progress)
        vertices = organ.surface.vertices
        self.grid = VoxelGrid.covering(vertices.min(axis=0), vertices.max(axis=0), 0.012, margin_cells=1)
        # Located once an organ, applied to every estimate.
        self._interpolation = self._elastic.interpolation(self.grid.points())
        self._query = organ.query_points

    def estimate(self, observation):
        return self._corrected(self._elastic.estimate(observation))

    def estimate_bare(self, cloud):
        return self._corrected(self._elastic.estimate_bare(cloud))

    def _corrected(self, elastic):
        self.elastic = elastic
        self.read = elastic.interpolated(self.grid.points(), self._interpolation)
        mean, sigma = self.read
        field = np.column_stack([0.5 * mean[:, 0], mean[:, 1], sigma]).reshape(*self.grid.shape, 3)
        return Corrected(elastic, self.grid, field, self._query)


@pytest.fixture(scope="module")
def organ():
    return load_organ(bundled_organ())


@pytest.fixture
def mine(organ, monkeypatch):
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    register_estimator("mine", PosteriorOnGrid)
    made = create_estimator(EstimatorConfig(estimator="mine", device="cpu"))
    made.load_organ(organ)
    yield made
    made.close()


def seen_of(organ):
    """Points of a bending organ with the preoperative places that they had."""
    scene = BendingOrgan(organ, 800, np.random.default_rng(0))
    return scene.points(1.2), scene.reference


@pytest.mark.parametrize("bare", [False, True])
def test_a_registered_estimator_reads_the_posterior_on_a_grid_and_adds_to_it(organ, mine, bare):
    points, reference = seen_of(organ)
    config = EstimatorConfig()
    if bare:
        estimate = mine.estimate_bare(make_bare_cloud(points, SIGMA_M, config)[0])
    else:
        estimate = mine.estimate(make_observation(points, reference, SIGMA_M, organ, config)[0])
    mean, sigma = mine.read
    assert len(mean) == np.prod(mine.grid.shape) and np.isfinite(mean).all() and (sigma > 0.0).all()
    # The same posterior, wherever it is asked for; cell centres far outside are extrapolated alike.
    expected, spread = mine.elastic.displacement_at(mine.grid.points())
    np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sigma, spread, rtol=0, atol=1e-12)
    # At cell centres what is added is exactly what was made of the posterior there.
    inside = np.abs(mine.grid.points() - organ.surface.vertices.mean(axis=0)).max(axis=1) < 0.03
    cells = mine.grid.points()[inside]
    displacement, _ = estimate.displacement_at(cells)
    added = np.column_stack([0.5 * mean[inside, 0], mean[inside, 1], sigma[inside]])
    np.testing.assert_allclose(displacement, mean[inside] + added, rtol=0, atol=1e-12)
    assert len(cells) > 50 and np.linalg.norm(displacement, axis=1).max() > 0.002


def test_what_was_observed_and_what_it_leaves_can_be_read_too(organ, mine):
    points, reference = seen_of(organ)
    mine.estimate(make_observation(points, reference, SIGMA_M, organ, EstimatorConfig())[0])
    elastic = mine.elastic
    patches = elastic.patches
    assert elastic.misfit.shape == patches.reference.shape == (len(patches.precision), 3)
    explained, _ = elastic.displacement_at(patches.reference)
    # Neither the registration nor the sensor is blamed for much, so that little is left beside the answer.
    left = patches.displacement - explained - elastic.misfit
    assert np.abs(left).max() < 0.003 < np.linalg.norm(patches.displacement, axis=1).max()
