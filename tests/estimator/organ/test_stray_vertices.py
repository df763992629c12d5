"""Vertices that a damaged number moves: named in a warning; segmented organs and their vessels are not suspected."""

import logging

import numpy as np
import pytest
import trimesh

from estimator.organ_folders import TIP, TUMOUR, describe, export
from estimator.shapes import ellipsoid
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.stray_vertices import stray_vertices
from softtissue_estimator.support.resources import bundled_organ

LIVER = ellipsoid((0.09, 0.06, 0.05), subdivisions=3)


def share_found(mesh, distance_m, tries, rng):
    """Share of single vertices, moved along one axis as a wrong digit moves them, that are found, and nothing else."""
    found = 0
    for _ in range(tries):
        vertex = int(rng.integers(len(mesh.vertices)))
        vertices = mesh.vertices.copy()
        vertices[vertex, rng.integers(3)] += distance_m * rng.choice([-1.0, 1.0])
        found += stray_vertices(SurfaceMesh(vertices, mesh.faces))[0].tolist() == [vertex]
    return found / tries


@pytest.mark.parametrize("subdivisions", [3, 4])
@pytest.mark.parametrize("distance_m", [0.02, 0.05, 0.3, 5.0])
def test_four_of_five_moved_vertices_are_found(subdivisions, distance_m):
    mesh = ellipsoid((0.09, 0.06, 0.05), subdivisions)
    assert stray_vertices(mesh)[0].tolist() == []
    assert share_found(mesh, distance_m, 100, np.random.default_rng(0)) >= 0.8


def test_recorded_organs_are_not_suspected_and_moved_vertices_of_theirs_found(test_data):
    files = [test_data / "openhelp" / "liver.stl", *sorted((test_data / "patient").glob("*.vtk"))]
    assert len(files) == 5
    for file in files:
        if file.suffix == ".vtk":
            pytest.importorskip("vtkmodules")
        mesh = read_mesh(file, 1e-3).mesh
        assert stray_vertices(mesh)[0].tolist() == [], file
        assert share_found(mesh, 0.02, 25, np.random.default_rng(1)) >= 0.8, file


def test_the_bundled_organ_is_not_suspected(caplog):
    with caplog.at_level(logging.WARNING):
        organ = load_organ(bundled_organ())
    assert "stray" not in caplog.text
    assert share_found(organ.surface, 0.02, 50, np.random.default_rng(2)) >= 0.8


def test_a_corner_that_one_triangle_alone_has_is_found():
    """In an STL, every triangle has corners of its own."""
    corners = LIVER.triangles.copy()
    corners[77, 1] += [0.0, 0.0, 0.03]
    soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(len(corners) * 3).reshape(-1, 3), process=False)
    soup.merge_vertices()
    found, distance = stray_vertices(SurfaceMesh(soup.vertices, soup.faces))
    assert len(found) == 1
    np.testing.assert_allclose(soup.vertices[found[0]], corners[77, 1], atol=1e-8)
    assert distance[0] == pytest.approx(0.03, abs=0.01)


def test_meshes_of_few_triangles_are_not_judged():
    cone = trimesh.creation.cone(radius=0.01, height=0.2, sections=20)
    assert stray_vertices(SurfaceMesh(np.asarray(cone.vertices), np.asarray(cone.faces)))[0].tolist() == []


def test_the_warning_names_the_vertex_of_the_file(tmp_path, caplog):
    rows = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in 1e3 * LIVER.vertices]
    rows += [f"f {a} {b} {c}" for a, b, c in LIVER.faces + 1]
    (tmp_path / "liver.obj").write_text("\n".join(rows))
    export(TUMOUR, tmp_path / "tumour.ply")
    describe(tmp_path, surface="liver.obj", attached=TIP)
    with caplog.at_level(logging.WARNING):
        load_organ(tmp_path)
    assert "stray" not in caplog.text
    vertex = 123
    x = rows[vertex].split()[1]
    rows[vertex] = rows[vertex].replace(x, f"{float(x) + 40.0:.3f}", 1)
    (tmp_path / "liver.obj").write_text("\n".join(rows))
    with caplog.at_level(logging.WARNING):
        load_organ(tmp_path)
    place = ", ".join(f"{float(c):.0f}" for c in rows[vertex].split()[1:])
    assert f"stray vertices, away from their neighbours: vertex {vertex} at {place} mm by" in caplog.text
    assert "are numbers in the file damaged?" in caplog.text
