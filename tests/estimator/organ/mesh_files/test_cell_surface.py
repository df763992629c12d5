"""The outside of volume cells of every kind, alone and mixed."""

import itertools
import logging

import numpy as np
import pytest
import trimesh

from estimator.shapes import box_tets
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, check_cells, surface_of_cells

BOX = box_tets()
CUBE = np.array(list(itertools.product((0.0, 1.0), repeat=3)))[[0, 4, 6, 2, 1, 5, 7, 3]]  # VTK's hexahedron
# Reference cells: corners, and the volume by hand.
CELLS = {
    "tetra": (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), 1.0 / 6.0),
    "pyramid": (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.0]]), 1.0 / 3.0),
    "wedge": (np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 2], [0, 1, 2], [1, 0, 2.0]]), 1.0),
    "hexahedron": (CUBE, 1.0),
}


def solid(vertices, blocks):
    check_cells(blocks, len(vertices))
    return trimesh.Trimesh(vertices, surface_of_cells(vertices, blocks), process=False)


@pytest.mark.parametrize("kind", CELLS)
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_single_cell_is_closed_and_faces_outward(kind, mirrored):
    vertices, volume = CELLS[kind]
    vertices = vertices * ([-1.0, 1.0, 1.0] if mirrored else 1.0)
    cell = solid(vertices, [CellBlock(kind, np.arange(len(vertices))[None])])
    assert cell.is_watertight
    assert cell.volume == pytest.approx(volume)


def test_faces_inside_a_mesh_are_left_out():
    outside = surface_of_cells(BOX.nodes, [CellBlock("tetra", BOX.tets)])
    assert {tuple(sorted(face)) for face in outside} == {tuple(sorted(face)) for face in BOX.boundary_faces}
    assert len(outside) == len(BOX.boundary_faces)


def test_turned_and_doubled_cells_change_nothing():
    tets = BOX.tets.copy()
    tets[::3] = tets[::3][:, [1, 0, 2, 3]]
    body = solid(BOX.nodes, [CellBlock("tetra", np.concatenate([tets, tets[5:9], BOX.tets[20:30]]))])
    assert body.is_watertight
    assert body.volume == pytest.approx(0.04 * 0.03 * 0.02)


def test_kinds_that_share_faces_make_one_body():
    """A cube with a pyramid on its top, a wedge on its side and a tetrahedron on the wedge's end."""
    vertices = np.concatenate([CUBE, [[0.5, 0.5, 2.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [1.5, 2.0, 0.3]]])
    blocks = [
        CellBlock("hexahedron", np.arange(8)[None]),
        CellBlock("pyramid", np.array([[4, 5, 6, 7, 8]])),
        CellBlock("wedge", np.array([[1, 5, 9, 2, 6, 10]])),
        CellBlock("tetra", np.array([[2, 6, 10, 11]])),
        CellBlock("line", np.array([[0, 8]])),
        CellBlock("triangle", np.array([[0, 6, 10]])),  # beside volume cells, surface cells have no say
    ]
    body = solid(vertices, blocks)
    assert body.is_watertight
    assert body.volume == pytest.approx(1.0 + 1.0 / 3.0 + 0.5 + 0.5 * 1.0 / 3.0)


def test_cells_of_higher_order_lose_all_but_their_corners(caplog):
    nodes = np.concatenate([CUBE, CUBE[[0, 1]] * 0.5])
    with caplog.at_level(logging.INFO):
        cell = solid(nodes, [CellBlock("hexahedron10", np.arange(10)[None])])
    assert cell.volume == pytest.approx(1.0)
    assert "hexahedron10: only their corners are used" in caplog.text


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5], [1, 0, 2, 3, 5, 4]])
def test_triangles_of_six_nodes_become_four(order):
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]])
    middles = [(corners[i] + corners[j]) / 2.0 + [0, 0, 0.1] for i, j in ((0, 1), (1, 2), (2, 0))]
    faces = surface_of_cells(np.concatenate([corners, middles]), [CellBlock("triangle6", np.array([order]))])
    assert {frozenset(face) for face in faces.tolist()} == {
        frozenset(f) for f in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
    }


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([CellBlock("polyhedron", np.zeros((1, 9), dtype=int))], "got cells of kind polyhedron with 9 nodes"),
        ([CellBlock("number 42 of VTK", np.zeros((1, 9), dtype=int))], "got cells of kind number 42 of VTK"),
        ([CellBlock("tetra", np.zeros((1, 3), dtype=int))], "got cells of kind tetra with 3 nodes"),
        ([CellBlock("tetra", np.array([[0, 1, 2, 9]]))], "expected cells of vertices 0 to 4, got vertex 9"),
        ([CellBlock("line3", np.array([[0, 1, 2]]))], "got 5 vertices and cells of kind line only"),
        ([], "got 5 vertices and no cells"),
    ],
)
def test_cells_without_a_surface_are_refused(blocks, message):
    with pytest.raises(MeshError, match=message):
        check_cells(blocks, 5)
