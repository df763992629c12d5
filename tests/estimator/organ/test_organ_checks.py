"""Wrong units, structures in another place or coordinate system."""

import logging

import numpy as np
import pytest

from estimator.organ_folders import LIVER, TUMOUR, describe, export
from estimator.shapes import sphere
from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import load_organ


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (1.0, r"got 1.1\de-09 litres .* with unit mm; .*, in m it would be 1.1\d litres: state m$"),
        (
            100.0,
            r"got 0.0011\d* litres .*, in cm it would be 1.1\d litres: scale the files by 10 and state mm$",
        ),
        (1e-6, r"expected an organ of 0.01 to 20 litres and at most 1 m, got .* with unit mm$"),
    ],
)
def test_wrong_units_are_named_with_what_to_change(folder, scale, message):
    export(LIVER, folder / "liver.ply", scale=scale)
    with pytest.raises(OrganError, match=message):
        load_organ(describe(folder))


def test_a_stray_vertex_metres_away_is_no_organ(folder):
    vertices = LIVER.vertices.copy()
    vertices[0] *= 1e4
    export(SurfaceMesh(vertices, LIVER.faces), folder / "liver.ply")
    with pytest.raises(OrganError, match="and at most 1 m, got"):
        load_organ(describe(folder))


@pytest.mark.parametrize(("scale", "ratio"), [(1.0, "0.00011"), (1e6, "1.1e\\+02")])
def test_structure_in_another_unit_is_refused(folder, scale, ratio):
    """The organ is about the origin, where a structure in metres is a dot inside it."""
    export(TUMOUR, folder / "tumour.ply", scale=scale)
    with pytest.raises(
        OrganError,
        match=rf"structure 'tumour': expected .* unit of the organ's, got one {ratio} times as long",
    ):
        load_organ(describe(folder))


AWAY = np.array([-0.1, 0.15, 0.3])


def test_structure_in_the_other_coordinate_system_is_recognised(folder):
    export(SurfaceMesh(LIVER.vertices + AWAY, LIVER.faces), folder / "liver.ply")
    export(SurfaceMesh((TUMOUR.vertices + AWAY) * [-1, -1, 1], TUMOUR.faces), folder / "tumour.ply")
    centre = [float(value) for value in 1e3 * (AWAY + np.array([0.09, 0.0, 0.0]))]
    attached = {"spheres": [{"centre": centre, "radius": 25}]}
    with pytest.raises(OrganError, match="mm away .* one of the files is in LPS and the other in RAS"):
        load_organ(describe(folder, attached=attached))
    organ = load_organ(describe(folder, attached=attached, structures=[]))
    assert organ.attached.any()
    attached = {"touching": {"mesh": "tumour.ply", "distance": 30}}
    with pytest.raises(OrganError, match="touching: .* got none, the nearest .* other in RAS"):
        load_organ(describe(folder, attached=attached, structures=[]))


def test_structure_mostly_outside_is_reported(folder, caplog):
    export(sphere(0.02, centre=(0.1, 0.0, 0.0)), folder / "tumour.ply")
    with caplog.at_level(logging.WARNING):
        load_organ(describe(folder))
    assert "structure 'tumour': only 1" in caplog.text
    assert "lies inside the organ" in caplog.text


def test_structure_far_from_the_organ_is_refused(folder):
    export(sphere(0.01, centre=(0.5, 0.0, 0.0)), folder / "tumour.ply")
    with pytest.raises(
        OrganError, match="structure 'tumour': expected it inside the organ, got it 400 mm away"
    ):
        load_organ(describe(folder))
