"""The table of single bare clouds: what its clouds are, and what its figures say."""

from types import SimpleNamespace

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_training.experiments.phantom import peak
from softtissue_training.experiments.phantom.own_case import own_phantom_case


@pytest.fixture(scope="module")
def case():
    return own_phantom_case()


def test_poses_are_off_by_what_is_said(case):
    clouds = list(peak.misregistered_clouds(case))
    assert len(clouds) == 6
    exact = case.correspondences.after
    for cloud in clouds:
        motion = fit_rigid(exact, cloud.points, np.ones(len(exact)))
        angle = np.degrees(np.arccos((np.trace(motion.rotation) - 1.0) / 2.0))
        shift = np.linalg.norm(cloud.points.mean(axis=0) - exact.mean(axis=0))
        assert angle == pytest.approx(5.0, abs=1e-6) and shift == pytest.approx(0.010, abs=1e-9)
        np.testing.assert_allclose(np.sqrt(np.diag(cloud.covariance)), [0.010] * 3 + [np.radians(5.0)] * 3)


def test_ends_of_the_patch_cover_it(case):
    halves = [{tuple(point) for point in cloud.points} for cloud in peak.cut_clouds(case, 0.5)]
    assert [len(half) for half in halves] == [600] * 4
    assert not halves[0] & halves[1] and not halves[2] & halves[3]


def test_resting_organ_is_seen_bent_by_two_millimetres(case):
    clouds = list(peak.resting_clouds(case))
    off = np.stack([cloud.points - case.correspondences.before for cloud in clouds])
    # On each coordinate noise of 1 mm, along the normal 2 mm more.
    assert np.sqrt((off**2).sum(axis=2).mean()) == pytest.approx(np.sqrt(3 + 4) * 1e-3, rel=0.03)
    assert all(not cloud.moved.any() and cloud.covariance is None for cloud in clouds)


def test_figures_of_a_condition(case):
    clouds = list(peak.cut_clouds(case, 0.5))
    off = 0.003 * np.ones_like(case.markers.displacement)

    class Wrong:
        """Off by 3 mm along each axis, which it says; one cloud it refuses."""

        def estimate_bare(self, cloud):
            if np.array_equal(cloud.points, clouds[0].points):
                raise InvalidInputError("expected another one")
            answer = (case.markers.displacement + off, np.full(len(off), 0.002))
            return SimpleNamespace(displacement_at=lambda points: answer)

    row = peak.measure("half", Wrong(), case, clouds)
    assert (row.clouds, row.answered) == (4, 3)
    assert row.mean == pytest.approx(row.worst) == pytest.approx(3.0 * np.sqrt(3.0))
    assert row.rms_z == pytest.approx(1.5) and row.sigma_over_error == pytest.approx(2.0 / 3.0)
