"""Repair what scans and their exporters commonly leave in an organ's surface."""

from __future__ import annotations

import logging
from dataclasses import replace

import igl
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh, face_areas, sum_by_index
from softtissue_estimator.organ.mesh_io import StoredMesh

_log = logging.getLogger(__name__)

_CRACK_WIDTH_SHARE = 1e-4  # of the largest extent: 0.02 mm of a liver
_SLIVER_VOLUME_SHARE = 1e-3  # of the largest body's volume
_SECOND_BODY_VOLUME_SHARE = 0.05  # of the largest body's volume
_LEAST_COMPACTNESS = 1e-5  # volume over area^1.5; a sphere has 0.094
# A flat lid over this share of a ball's surface is off by twice the share times its radius: 4 mm for a liver, less
# than a cell of the paper's grid.
LARGEST_HOLE_SHARE = 0.03
_ALL_HOLES_SHARE = 0.1


def clean_organ_surface(stored: StoredMesh, name: str) -> StoredMesh:
    """Repair a surface, with a line in the log for each thing that was done.

    - Cracks: vertices on open edges that almost coincide are merged.
    - Triangles that lie on each other: of equal ones one stays, opposite ones (walls between parts) go.
    - Faces that disagree with their neighbours are turned; a surface wound inward is turned as a whole.
    - Bodies: slivers, shells inside the organ and bodies of less than 5 % of its volume are dropped; closed cavities,
      which are wound inward, and bodies that overlap the organ stay.
    - Small holes get a lid: a new vertex in their middle (behind all others) and a fan of triangles. Large ones
      stay; `check_closed` refuses them.

    Self-intersections stay.

    Parameters
    ----------
    stored : StoredMesh
    name : str
        What to call the mesh in messages.

    Raises
    ------
    MeshError
        If no body encloses a volume, or there are several large ones.
    """
    stored = _without_double_faces(_without_cracks(stored, name), name)
    stored = _keep_bodies(_turned(stored, name), name)
    return _with_lids(stored, name)


def check_closed(mesh: SurfaceMesh, name: str) -> None:
    """Raise MeshError if the surface has a hole that is too large for a lid, or too many holes."""
    edges = _open_edges(mesh.faces)
    if len(edges) == 0:
        return
    hole, count, area = _holes(mesh.vertices, edges)
    share = area / float(face_areas(mesh).sum())
    if share.max() <= LARGEST_HOLE_SHARE and share.sum() <= _ALL_HOLES_SHARE:
        return  # what is left open beside lids: fins, edges of three faces
    corners = mesh.vertices[edges[hole == share.argmax()].ravel()]
    more = f" and {count - 1} more" if count > 1 else ""
    raise MeshError(
        f"mesh {name}: expected a closed surface, got an opening {1e3 * np.ptp(corners, axis=0).max():.0f} mm across, "
        f"{100.0 * share.max():.2g} % of the surface{more}; close it where the mesh was made, or with a tool "
        "such as MeshLab (Close Holes)"
    )


def _without_cracks(stored: StoredMesh, name: str) -> StoredMesh:
    """Merge vertices of open edges that are closer to each other than any detail."""
    mesh = stored.mesh
    open_vertices = np.unique(_open_edges(mesh.faces))
    if len(open_vertices) == 0:
        return stored
    near = _CRACK_WIDTH_SHARE * float(np.ptp(mesh.vertices, axis=0).max())
    pairs = open_vertices[cKDTree(mesh.vertices[open_vertices]).query_pairs(near, output_type="ndarray")]
    if len(pairs) == 0:
        return stored
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(pairs), dtype=np.int8), pairs.T), shape=(size, size))
    group = connected_components(graph, directed=False)[1]
    first = np.full(int(group.max()) + 1, size, dtype=np.int64)
    np.minimum.at(first, group, np.arange(size))
    place = first[group]
    _log.warning("mesh %s: merged vertices along cracks: %d", name, int((place != np.arange(size)).sum()))
    faces = place[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    merged = np.where(stored.vertex_of_stored >= 0, place[stored.vertex_of_stored], -1)
    return replace(stored, vertex_of_stored=merged).with_faces(faces)


def _without_double_faces(stored: StoredMesh, name: str) -> StoredMesh:
    faces = stored.mesh.faces
    _, first, same = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    if len(first) == len(faces):
        return stored
    same = same.reshape(-1)
    # +1 if a face runs through its corners in ascending order, -1 if in descending.
    smallest = faces.argmin(axis=1)
    row = np.arange(len(faces))
    ascending = faces[row, (smallest + 1) % 3] < faces[row, (smallest + 2) % 3]
    sense = np.where(ascending, 1, -1)
    net = np.sign(np.bincount(same, weights=sense)).astype(np.int64)
    if not net.any():
        # Every face is there from both sides.
        keep = np.sort(first)
    else:
        agreeing = np.flatnonzero(sense == net[same])
        keep = np.sort(agreeing[np.unique(same[agreeing], return_index=True)[1]])
    _log.warning("mesh %s: dropped triangles that lie on others: %d", name, len(faces) - len(keep))
    return stored.with_faces(faces[keep])


def _turned(stored: StoredMesh, name: str) -> StoredMesh:
    """Make neighbouring faces agree; where they had to be turned, every body is wound outward."""
    mesh = stored.mesh
    directed = mesh.faces.ravel() * len(mesh.vertices) + np.roll(mesh.faces, -1, axis=1).ravel()
    if len(np.unique(directed)) == len(directed):
        return stored
    _log.warning("mesh %s: neighbouring faces are wound in opposite directions and are turned", name)
    faces = np.asarray(igl.bfs_orient(mesh.faces)[0], dtype=np.int64)
    body = _body_of_face(mesh)
    inward = _body_volumes(mesh.vertices, faces, body) < 0.0
    faces = np.where(inward[body][:, None], faces[:, ::-1], faces)
    return replace(stored, mesh=SurfaceMesh(mesh.vertices, faces))


def _keep_bodies(stored: StoredMesh, name: str) -> StoredMesh:
    """Wind the largest body outward; drop small ones beside it and refuse a second large one."""
    mesh = stored.mesh
    if len(mesh.faces) == 0:  # one vertex may be so far away that all others are in one place
        raise MeshError(f"mesh {name}: expected a surface that encloses a volume, got none after its repair")
    body = _body_of_face(mesh)
    volumes = _body_volumes(mesh.vertices, mesh.faces, body)
    main = int(np.abs(volumes).argmax())
    largest = abs(float(volumes[main]))
    if largest < _LEAST_COMPACTNESS * float(face_areas(mesh).sum()) ** 1.5:
        raise MeshError(f"mesh {name}: expected a surface that encloses a volume, got an open or flat one")
    faces = mesh.faces
    if volumes[main] < 0.0:
        _log.info("mesh %s: wound inward, turned outward", name)
        faces, volumes = faces[:, ::-1], -volumes
    keep = np.abs(volumes) >= _SLIVER_VOLUME_SHARE * largest
    slivers = int((~keep).sum())
    if slivers:
        _log.warning("mesh %s: ignored bodies without volume beside the organ: %d", name, slivers)
    for other in np.flatnonzero(keep):
        if other == main:
            continue
        inside = _share_inside(mesh.vertices, faces[body == main], faces[body == other])
        size = _millilitres(volumes[other])
        if inside > 0.5 and volumes[other] < 0.0:
            _log.info("mesh %s: a cavity of %s ml", name, size)
        elif inside == 1.0:
            _log.warning("mesh %s: a shell of %s ml inside the organ is ignored", name, size)
            keep[other] = False
        elif inside > 0.0:
            _log.info("mesh %s: a body of %s ml that overlaps the organ is part of it", name, size)
            faces = np.where(((body == other) & (volumes[other] < 0.0))[:, None], faces[:, ::-1], faces)
        elif abs(volumes[other]) < _SECOND_BODY_VOLUME_SHARE * largest:
            _log.warning("mesh %s: a body of %s ml beside the organ is ignored", name, size)
            keep[other] = False
        else:
            raise MeshError(
                f"mesh {name}: expected one body, got a second of {size} ml beside that of {_millilitres(largest)} ml; "
                "join them into one surface, or make an organ of each"
            )
    if keep.all() and faces is mesh.faces:
        return stored
    return stored.with_faces(faces[keep[body]])


def _millilitres(volume_m3: float) -> str:
    size = 1e6 * abs(float(volume_m3))
    return f"{size:.0f}" if size >= 100.0 else f"{size:.2g}"


def _with_lids(stored: StoredMesh, name: str) -> StoredMesh:
    """Close every hole of up to `LARGEST_HOLE_SHARE` of the surface, unless all of them together are large."""
    mesh = stored.mesh
    edges = _open_edges(mesh.faces)
    if len(edges) == 0:
        return stored
    hole, count, area = _holes(mesh.vertices, edges)
    share = area / float(face_areas(mesh).sum())
    small = np.flatnonzero(share <= LARGEST_HOLE_SHARE)
    if len(small) == 0 or share[small].sum() > _ALL_HOLES_SHARE:
        return stored
    middles = np.array([mesh.vertices[np.unique(edges[hole == i])].mean(axis=0) for i in small])
    number = np.full(count, -1, dtype=np.int64)
    number[small] = len(mesh.vertices) + np.arange(len(small))
    lidded = number[hole] >= 0
    lids = np.column_stack([edges[lidded][:, ::-1], number[hole[lidded]]])
    _log.warning(
        "mesh %s: closed small holes: %d, the largest %.2g %% of the surface",
        name,
        len(small),
        100.0 * share[small].max(),
    )
    closed = SurfaceMesh(np.concatenate([mesh.vertices, middles]), np.concatenate([mesh.faces, lids]))
    return replace(stored, mesh=closed)


def _open_edges(faces: IntArray) -> IntArray:
    """Edges that one face alone has, as that face runs through them, (e, 2)."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    _, first, count = np.unique(np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True)
    open_edges: IntArray = directed[np.sort(first[count == 1])]
    return open_edges


def _holes(vertices: FloatArray, edges: IntArray) -> tuple[IntArray, int, FloatArray]:
    """Return the hole of each open edge, (e,), how many there are and the area of a lid on each, m^2."""
    size = len(vertices)
    graph = coo_array((np.ones(len(edges), dtype=np.int8), edges.T), shape=(size, size))
    _, hole = np.unique(connected_components(graph, directed=False)[1][edges[:, 0]], return_inverse=True)
    hole = hole.reshape(-1).astype(np.int64)
    count = int(hole.max()) + 1
    used = np.bincount(hole, minlength=count).astype(np.float64)
    middle = np.column_stack([np.bincount(hole, vertices[edges[:, 0], k], count) / used for k in range(3)])
    start, end = vertices[edges[:, 0]] - middle[hole], vertices[edges[:, 1]] - middle[hole]
    area = sum_by_index(hole, 0.5 * np.linalg.norm(np.cross(start, end), axis=1), count)
    return hole, count, area


def _share_inside(vertices: FloatArray, main: IntArray, other: IntArray) -> float:
    """Share of the vertices of one set of faces that another set encloses."""
    points = np.ascontiguousarray(vertices[np.unique(other)])
    winding = np.asarray(igl.fast_winding_number(vertices, np.ascontiguousarray(main), points))
    return float((np.abs(winding) > 0.5).mean())


def _body_of_face(mesh: SurfaceMesh) -> IntArray:
    """Tell which connected part of the surface each face belongs to, (m,)."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, 1, axis=1).ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(size, size))
    body = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    return np.unique(body, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _body_volumes(vertices: FloatArray, faces: IntArray, body: IntArray) -> FloatArray:
    """Signed volume of every body, each about its own middle so that holes change it little, m^3."""
    count = int(body.max()) + 1
    corners = vertices[faces]
    used = np.bincount(body, minlength=count).astype(np.float64)
    middle = np.column_stack([np.bincount(body, corners.mean(axis=1)[:, k], count) / used for k in range(3)])
    corners = corners - middle[body][:, None]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    return sum_by_index(body, volume, count)
