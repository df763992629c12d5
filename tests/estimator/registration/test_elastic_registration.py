"""Elastic registration of a part of a deformed surface without correspondences, where the truth is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.elastic_registration import (
    ElasticRegistrationSettings,
    register_elastically,
)
from training.phantom_cases import MARKERS_M, bend, ellipsoid, seen_points

QUICK = ElasticRegistrationSettings(falling_turns=6, last_turns=2)


@pytest.fixture(scope="module")
def organ():
    """The ellipsoid, held at its end on the side of minus x."""
    surface = ellipsoid()
    return make_organ("ellipsoid", "organ", surface, (), surface.vertices[:, 0] < -0.045)


@pytest.fixture(scope="module")
def found(organ):
    rng = np.random.default_rng(0)
    before = seen_points(500)
    after = before + bend(before) + 0.0005 * rng.normal(size=before.shape)
    return before, register_elastically(after, organ, MARKERS_M, 0.0005, settings=QUICK)


def test_markers_are_found_from_the_surface_alone(found):
    error = np.linalg.norm(found[1].displacement - bend(MARKERS_M), axis=1)
    moved = np.linalg.norm(bend(MARKERS_M), axis=1)
    assert error.mean() < 0.45 * moved.mean()
    assert error.max() < 0.0045


def test_pairs_lie_on_the_surface_where_the_points_were(found):
    before, fit = found
    size = np.linalg.norm(fit.reference / [0.060, 0.045, 0.040], axis=1)
    assert np.all(np.abs(size - 1.0) < 0.02)
    assert np.linalg.norm(fit.reference - before, axis=1).mean() < 0.0035
    assert fit.counted.mean() > 0.95 and fit.rms_m == pytest.approx(0.0005, rel=0.35)


def test_predicted_deviation_is_of_the_size_of_the_error(found):
    error = found[1].displacement - bend(MARKERS_M)
    assert 0.1 < np.sqrt((error**2).mean() / (found[1].sigma ** 2).mean()) < 2.5


def test_an_organ_that_nothing_holds_follows_a_rigid_motion():
    surface = ellipsoid()
    free = make_organ("ellipsoid", "organ", surface, (), np.zeros(len(surface.vertices), dtype=bool))
    turn = Rotation.from_euler("xyz", [8.0, -6.0, 5.0], degrees=True).as_matrix()
    shift = np.array([0.004, -0.003, 0.005])
    before = surface.vertices[surface.vertices[:, 0] > -0.02]
    fit = register_elastically(before @ turn.T + shift, free, MARKERS_M, 0.0005, settings=QUICK)
    np.testing.assert_allclose(MARKERS_M + fit.displacement, MARKERS_M @ turn.T + shift, atol=0.001)


def test_points_with_normals_do_not_end_up_on_the_other_side():
    # A disc 16 mm thick whose upper side lies 6 mm further down: nearer to the lower side, but facing away from it.
    ball = ellipsoid()
    disc = SurfaceMesh(ball.vertices * [1.0, 1.0, 0.2], ball.faces)
    organ = make_organ("disc", "organ", disc, (), disc.vertices[:, 0] < -0.045)
    upper = disc.vertices
    upper = upper[(upper[:, 2] > 0.004) & (upper[:, 0] > -0.03)]
    normals = np.tile([0.0, 0.0, 1.0], (len(upper), 1))
    fit = register_elastically(
        upper - np.array([0.0, 0.0, 0.006]), organ, upper, 0.0005, normals=normals, settings=QUICK
    )
    assert fit.displacement[:, 2].mean() < -0.004
    assert (fit.reference[fit.counted][:, 2] > 0.0).all()


@pytest.mark.parametrize("bad", [np.zeros((5, 3)), np.zeros((30, 2)), np.full((30, 3), np.nan)])
def test_unusable_points_are_refused(organ, bad):
    with pytest.raises(InvalidInputError, match="at least 20 finite points"):
        register_elastically(bad, organ, MARKERS_M, 0.001)
