import numpy as np
import pytest
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.bending_organ import BendingOrgan
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.surface_lookup import CELL_M
from softtissue_estimator.support.resources import bundled_organ


@pytest.fixture(scope="module")
def organ():
    return load_organ(bundled_organ())


def test_the_organ_swings_and_stays_where_it_is_attached(organ):
    scene = BendingOrgan(organ, 5000, np.random.default_rng(0))
    assert organ.surface_lookup.distance(scene.reference).max() < 1.5 * CELL_M
    up = np.ptp(organ.surface.vertices, axis=0).argmin()
    moved = scene.points(1.5) - scene.reference
    distance = cKDTree(organ.surface.vertices[organ.attached]).query(scene.reference)[0]
    end = distance > np.quantile(distance, 0.99)
    assert 0.008 < moved[end, up].mean() < 0.010
    held = distance < 0.005
    assert held.sum() > 100 and abs(moved[held, up].mean()) < 0.0001
    assert np.abs(scene.points(3.0) - scene.reference).max() < 0.004


def test_an_organ_that_is_attached_nowhere_swings_about_its_end(organ):
    scene = BendingOrgan(organ.with_attached(np.zeros_like(organ.attached)), 5000, np.random.default_rng(0))
    extent = np.ptp(organ.surface.vertices, axis=0)
    along, up = scene.reference[:, extent.argmax()], extent.argmin()
    moved = scene.points(1.5) - scene.reference
    assert 0.007 < moved[along > np.quantile(along, 0.98), up].mean() < 0.010
    assert abs(moved[along < np.quantile(along, 0.02), up].mean()) < 0.001


def test_amplitude_and_period_are_those_asked_for(organ):
    scenes = [
        BendingOrgan(organ, 2000, np.random.default_rng(0), amplitude, 2.0) for amplitude in (0.0, 0.03)
    ]
    assert np.array_equal(scenes[0].reference, scenes[1].reference)
    # The same noise in both, so that the difference is the motion alone: largest after half a period.
    moved = scenes[1].points(1.0) - scenes[0].points(1.0)
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(0.03)
    assert np.abs(scenes[1].points(2.0) - scenes[0].points(2.0)).max() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("count", "amplitude", "period"), [(0, 0.01, 3.0), (5, 0.5, 3.0), (5, 0.01, 0.0)])
def test_impossible_scenes_are_refused(organ, count, amplitude, period):
    with pytest.raises(InvalidInputError, match="bending organ: expected at least 1 point"):
        BendingOrgan(organ, count, np.random.default_rng(0), amplitude, period)
