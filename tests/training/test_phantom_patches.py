import numpy as np
import pytest
import trimesh

from softtissue_estimator.mesh import SurfaceMesh, vertex_areas
from softtissue_training.phantom.patches import distance_along, patch

BALL = trimesh.creation.icosphere(subdivisions=4)
MESH = SurfaceMesh(np.asarray(BALL.vertices), np.asarray(BALL.faces))


def test_way_along_a_ball_is_near_the_great_circle_and_not_the_chord():
    distance = distance_along(MESH, np.array([0.0, 0.0, 1.0]))
    arc = np.arccos(
        np.clip(MESH.vertices[:, 2] / MESH.vertices[np.argmax(MESH.vertices[:, 2]), 2], -1.0, 1.0)
    )
    far = arc > 0.5
    # Edges cut through the ball (a little shorter) and zigzag (up to 2/sqrt(3) longer).
    assert np.all(distance[far] > 0.99 * arc[far])
    assert np.all(distance[far] < 1.2 * arc[far])


@pytest.mark.parametrize("share", [0.1, 0.2, 0.5])
def test_patch_holds_the_share_around_its_point(share):
    chosen = patch(MESH, np.array([0.0, 2.0, 0.0]), share)
    areas = vertex_areas(MESH)
    assert areas[chosen].sum() / areas.sum() == pytest.approx(share, abs=0.002)
    # A cap of that area reaches down to y = 1 - 2 share (Archimedes).
    assert MESH.vertices[chosen, 1].min() == pytest.approx(1.0 - 2.0 * share, abs=0.15)
    assert not chosen[np.argmin(MESH.vertices[:, 1])]
