import numpy as np
import pytest

from estimator.shapes import organ_of, sphere
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.surface_lookup import SurfaceLookup

ORGAN = organ_of(sphere(0.05))
CONFIG = EstimatorConfig()
REFERENCE = ORGAN.surface.vertices[:100]
SHIFT = np.array([0.01, -0.02, 0.03])


def test_displacement_is_now_minus_before():
    observation, rejected = make_observation(REFERENCE + SHIFT, REFERENCE, None, ORGAN, CONFIG)
    np.testing.assert_allclose(observation.displacement, np.tile(SHIFT, (100, 1)), atol=1e-15)
    np.testing.assert_array_equal(observation.reference, REFERENCE)
    assert (observation.sigma == CONFIG.default_sigma_m).all()
    assert rejected == 0


def test_each_kind_of_unusable_point_is_dropped_and_counted():
    points, reference, sigma = REFERENCE + SHIFT, REFERENCE.copy(), np.full(100, 0.002)
    points[0, 1] = np.nan
    points[1, 2] = reference[1, 2] = np.inf
    reference[2, 0] = np.nan
    sigma[3] = np.nan
    sigma[4] = 0.0
    sigma[5] = -0.001
    points[6] = reference[6] + [0.0, 0.0, 0.151]
    reference[7] *= 1.3
    points[7] = reference[7]
    kept = np.arange(8, 100)
    observation, rejected = make_observation(points, reference, sigma, ORGAN, CONFIG)
    assert rejected == 8
    np.testing.assert_array_equal(observation.reference, REFERENCE[kept])


def test_points_are_located_once_and_only_on_the_surface_they_were_checked_against(monkeypatch):
    points, reference = REFERENCE + SHIFT, REFERENCE.copy()
    reference[7] *= 1.3
    points[7] = reference[7]
    observation, _ = make_observation(points, reference, None, ORGAN, CONFIG)
    other = organ_of(sphere(0.05, subdivisions=2)).surface_lookup
    elsewhere = other.nearest_sample(observation.reference)
    here = ORGAN.surface_lookup.nearest_sample(observation.reference)
    np.testing.assert_array_equal(observation.nearest_sample(other), elsewhere)
    monkeypatch.setattr(SurfaceLookup, "nearest_sample", None)
    np.testing.assert_array_equal(observation.nearest_sample(ORGAN.surface_lookup), here)


def test_limits_come_from_the_configuration():
    config = EstimatorConfig(max_displacement_m=0.03, max_reference_distance_m=0.02)
    reference = REFERENCE * 1.3  # 15 mm off the surface
    assert make_observation(reference, reference, None, ORGAN, config)[1] == 0
    with pytest.raises(InvalidInputError, match="100 moved more than 30 mm"):
        make_observation(REFERENCE + SHIFT, REFERENCE, None, ORGAN, config)


def test_too_few_usable_points_say_why():
    points = REFERENCE[:4].copy()
    points[:2] = np.nan
    with pytest.raises(
        InvalidInputError, match=r"expected at least 3 usable ones, got 2 of 4 \(2 not finite"
    ):
        make_observation(points, REFERENCE[:4], None, ORGAN, CONFIG)


def test_arguments_stay_as_they_are_and_are_not_shared():
    points, reference, sigma = REFERENCE + SHIFT, REFERENCE.copy(), np.full(100, 0.002)
    points[0] = np.nan
    before = points.copy(), reference.copy(), sigma.copy()
    observation, _ = make_observation(points, reference, sigma, ORGAN, CONFIG)
    for now, then in zip((points, reference, sigma), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert not np.shares_memory(observation.reference, reference)


@pytest.mark.parametrize(
    ("points", "reference", "sigma", "message"),
    [
        (np.zeros((5, 2)), np.zeros((5, 3)), None, r"surface points: expected shape \(n, 3\), got \(5, 2\)"),
        (np.zeros((5, 3)), np.zeros(3), None, r"reference points: expected shape \(n, 3\), got \(3,\)"),
        (np.zeros((5, 3)), np.zeros((4, 3)), None, "one reference for each of 5 points, got 4"),
        (np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(4), "one for each of 5 points, got shape"),
        ([["a", "b", "c"]], np.zeros((1, 3)), None, "expected numbers"),
        (np.empty((0, 3)), np.empty((0, 3)), None, "expected at least 3 usable ones, got 0 of 0"),
    ],
)
def test_impossible_arguments_are_refused(points, reference, sigma, message):
    with pytest.raises(InvalidInputError, match=message):
        make_observation(points, reference, sigma, ORGAN, CONFIG)
