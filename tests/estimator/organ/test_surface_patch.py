import numpy as np
import pytest
import trimesh
import yaml

from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.surface_patch import distance_along, patch

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


def organ_attached_by(folder, patch_entry):
    trimesh.Trimesh(80.0 * MESH.vertices, MESH.faces, process=False).export(folder / "ball.ply")
    content = {"unit": "mm", "surface": "ball.ply", "attached": {"patch": patch_entry}}
    (folder / "organ.yaml").write_text(yaml.safe_dump(content))
    return load_organ(folder)


def test_organ_may_be_attached_by_a_share_of_its_surface(tmp_path):
    organ = organ_attached_by(tmp_path, {"centre": [0, 100, 0], "share": 0.21})
    areas = vertex_areas(organ.surface)
    assert areas[organ.attached].sum() / areas.sum() == pytest.approx(0.21, abs=0.002)
    assert organ.surface.vertices[organ.attached, 1].min() > 0.0


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            {"centre": [0, 100, 0], "share": 21},
            "attached.patch.share: expected a share of the surface below 1, got 21",
        ),
        ({"centre": [0, 100, 0]}, "attached.patch.share: expected a positive number, got nothing"),
        ({"centre": [0, 100], "share": 0.2}, "attached.patch.centre: expected 3 numbers"),
    ],
)
def test_patches_that_cannot_be_meant_are_refused(tmp_path, entry, words):
    with pytest.raises(OrganError, match=words):
        organ_attached_by(tmp_path, entry)
