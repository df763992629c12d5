import numpy as np
import pytest

from softtissue_estimator.bending_organ import BendingOrgan
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ import load_organ
from softtissue_estimator.resources import bundled_organ
from softtissue_estimator.surface_lookup import CELL_M


def test_the_organ_swings_and_its_fixed_end_stays():
    organ = load_organ(bundled_organ())
    scene = BendingOrgan(organ, 5000, np.random.default_rng(0))
    assert organ.surface_lookup.distance(scene.reference).max() < 1.5 * CELL_M
    up, along = (
        np.ptp(organ.surface.vertices, axis=0).argmin(),
        np.ptp(organ.surface.vertices, axis=0).argmax(),
    )
    moved = scene.points(1.5) - scene.reference
    end = scene.reference[:, along] > np.quantile(scene.reference[:, along], 0.98)
    start = scene.reference[:, along] < np.quantile(scene.reference[:, along], 0.02)
    assert 0.007 < moved[end, up].mean() < 0.010
    assert abs(moved[start, up].mean()) < 0.001
    assert np.abs(scene.points(3.0) - scene.reference).max() < 0.004


def test_amplitude_and_period_are_those_asked_for():
    organ = load_organ(bundled_organ())
    scenes = [
        BendingOrgan(organ, 2000, np.random.default_rng(0), amplitude, 2.0) for amplitude in (0.0, 0.03)
    ]
    assert np.array_equal(scenes[0].reference, scenes[1].reference)
    # The same noise in both, so that the difference is the motion alone: largest after half a period.
    moved = scenes[1].points(1.0) - scenes[0].points(1.0)
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(0.03)
    assert np.abs(scenes[1].points(2.0) - scenes[0].points(2.0)).max() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("count", "amplitude", "period"), [(0, 0.01, 3.0), (5, 0.5, 3.0), (5, 0.01, 0.0)])
def test_impossible_scenes_are_refused(count, amplitude, period):
    with pytest.raises(InvalidInputError, match="bending organ: expected at least 1 point"):
        BendingOrgan(load_organ(bundled_organ()), count, np.random.default_rng(0), amplitude, period)
