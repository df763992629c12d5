import numpy as np
import pytest

from estimator.shapes import ellipsoid, organ_of
from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.seen_surface import seen_surface
from softtissue_estimator.observation.visibility import seen_fraction, visible_fraction
from softtissue_estimator.organ.mesh import face_areas, sample_faces

ORGAN = organ_of(ellipsoid())


def visible_share(points):
    return visible_fraction(ORGAN, Observation(points, np.zeros_like(points), np.full(len(points), 0.001)))


@pytest.mark.parametrize("height", [-0.02, 0.0, 0.015])
def test_dense_cloud_sees_the_area_it_covers(height):
    visible = ORGAN.surface.triangles[:, :, 2].mean(axis=1) > height
    areas = face_areas(ORGAN.surface)
    points = sample_faces(ORGAN.surface, visible, 0.002)[0]
    assert visible_share(points) == pytest.approx(areas[visible].sum() / areas.sum(), abs=0.035)


def test_whole_surface_and_none_of_it():
    everything = sample_faces(ORGAN.surface, None, 0.002)[0]
    assert visible_share(everything) == pytest.approx(1.0, abs=0.005)
    assert visible_share(np.empty((0, 3))) == 0.0
    assert visible_share(np.full((5, 3), 10.0)) == 0.0


def test_repeated_points_see_no_more():
    points = sample_faces(ORGAN.surface, ORGAN.surface.triangles[:, 0, 0] > 0.0, 0.002)[0]
    assert visible_share(np.repeat(points, 3, axis=0)) == visible_share(points)


@pytest.mark.parametrize("height", [-0.02, 0.0, 0.015])
def test_averages_of_cells_see_the_area_that_they_stand_for(height):
    visible = ORGAN.surface.triangles[:, :, 2].mean(axis=1) > height
    areas = face_areas(ORGAN.surface)
    points = sample_faces(ORGAN.surface, visible, 0.002)[0]
    seen = seen_surface(BareCloud(points, np.full(len(points), 0.001)))
    share = areas[visible].sum() / areas.sum()
    assert seen_fraction(ORGAN, seen.position) == pytest.approx(share, abs=0.05)
    assert seen_fraction(ORGAN, np.empty((0, 3))) == 0.0
