"""Coarse tetrahedra of an organ, and where points lie in them.

fTetWild (through pytetwild) fills surfaces as scans leave them: with holes, self-intersections and slivers. It runs
in a process of its own, because it holds Python's lock for seconds, leaves files in the working folder and, being
C++, may end the process on a mesh it cannot digest. Its result differs a little from run to run; whoever needs the
same mesh again keeps it (`cache`).
"""

import logging
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh, enclosed_volume
from softtissue_estimator.support.leftovers import child_environment, run_contained, temporary_folder

_log = logging.getLogger(__name__)
_CUBED_EDGES_PER_VOLUME = 450.0  # edge length = cube root of volume / this; gives 500 to 900 nodes for organs
_ENVELOPE_SHARE = 0.01  # how far the tetrahedra may leave the surface, of the bounding box's diagonal
_FEWEST_NODES, _MOST_NODES = 250, 1100  # fewer resolve no bending, with more a frame takes too long
_TIMEOUT_S = 300.0
_LOCATION_CANDIDATES = 24  # tetrahedra with the nearest centroids, among which a point is looked for
_MOST_EXTRAPOLATION = 0.75  # lowest weight, below zero
_WORKER = Path(__file__).with_name("tetrahedra_worker.py")


@dataclass(frozen=True, eq=False)
class VolumeMesh:
    """Tetrahedra.

    Parameters
    ----------
    nodes : (n, 3) float64, m
    tets : (m, 4) int64
        Node indices, positive volume: seen from outside the first three are wound counter-clockwise.
    """

    nodes: FloatArray
    tets: IntArray

    @cached_property
    def volumes(self) -> FloatArray:
        """Volume of every tetrahedron, (m,) m^3."""
        return _signed_volumes(self.nodes, self.tets)

    @cached_property
    def boundary_faces(self) -> IntArray:
        """Faces that belong to one tetrahedron only, wound counter-clockwise from outside, (b, 3)."""
        faces = self.tets[:, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]].reshape(-1, 3)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        return np.asarray(faces[first[count == 1]], dtype=np.int64)

    @cached_property
    def inverse_edges(self) -> FloatArray:
        """Matrices that take an offset from a tetrahedron's last node to its first three weights, (m, 3, 3) 1/m."""
        corners = self.nodes[self.tets]
        edges = np.transpose(corners[:, :3] - corners[:, 3:], (0, 2, 1))
        return np.asarray(np.linalg.inv(edges), dtype=np.float64)

    @cached_property
    def _centroid_tree(self) -> cKDTree:
        return cKDTree(self.nodes[self.tets].mean(axis=1))

    def weights(self, points: FloatArray, tet: IntArray) -> FloatArray:
        """Barycentric weights of (n, 3) points (m) in the given tetrahedra (n,), (n, 4).

        Outside a tetrahedron they extrapolate linearly, which carries local rotations to points just outside the
        coarse mesh; no weight goes below -0.75, so that a distant point does not move implausibly far.
        """
        offset = points - self.nodes.take(self.tets[:, 3].take(tet), axis=0)
        first = np.einsum("nij,nj->ni", self.inverse_edges.take(tet, axis=0), offset)
        weights = np.column_stack([first, 1.0 - first.sum(axis=1)])
        lowest = weights.min(axis=1, keepdims=True)
        if lowest.min(initial=0.0) >= -_MOST_EXTRAPOLATION:
            return weights
        # Blending towards the centroid keeps the sum at one.
        excess = np.maximum(-lowest - _MOST_EXTRAPOLATION, 0.0)
        blend = excess / np.maximum(0.25 - lowest, 1e-12)
        return np.asarray(weights + blend * (0.25 - weights), dtype=np.float64)

    def locate(self, points: FloatArray) -> IntArray:
        """Find the tetrahedron around each of (n, 3) points (m), or the one that reaches it best, (n,)."""
        count = min(_LOCATION_CANDIDATES, len(self.tets))
        best = np.empty(len(points), dtype=np.int64)
        for start in range(0, len(points), 8192):
            part = points[start : start + 8192]
            candidates = self._centroid_tree.query(part, k=count)[1].reshape(len(part), count)
            offset = part[:, None] - self.nodes[self.tets[candidates, 3]]
            first = np.einsum("ncij,ncj->nci", self.inverse_edges[candidates], offset)
            lowest = np.minimum(first.min(axis=2), 1.0 - first.sum(axis=2))
            best[start : start + len(part)] = candidates[np.arange(len(part)), lowest.argmax(axis=1)]
        return best

    def interpolation(self, points: FloatArray) -> csr_array:
        """Sparse matrix (n, nodes) that interpolates nodal values at (n, 3) points, m."""
        return self.interpolation_in(points, self.locate(points))

    def interpolation_in(self, points: FloatArray, tet: IntArray) -> csr_array:
        """Do the same for points that lie in the given tetrahedra, (n,)."""
        rows = np.arange(0, 4 * len(points) + 1, 4)
        entries = (self.weights(points, tet).ravel(), self.tets.take(tet, axis=0).ravel(), rows)
        return csr_array(entries, shape=(len(points), len(self.nodes)))


def tetrahedralise(surface: SurfaceMesh, progress: Callable[[str], None]) -> VolumeMesh:
    """Fill a surface with a few thousand tetrahedra (500 to 900 nodes for most organs).

    Parameters
    ----------
    surface : SurfaceMesh
        m, wound outward; holes and self-intersections are tolerated.
    progress : callable
        Told what is going on.

    Raises
    ------
    MeshError
        If fTetWild fails or fills less than half or more than twice the volume.
    """
    volume = enclosed_volume(surface)
    if not volume > 0.0:
        raise MeshError(f"volume mesh: expected a surface with a positive volume, got {1e6 * volume:.3g} ml")
    edge = edge_length(volume)
    mesh = None
    for _ in range(3):
        progress(f"filling the organ with tetrahedra of {1e3 * edge:.1f} mm, which takes 5 to 60 s")
        mesh = clean_tets(*_run_ftetwild(surface, edge))
        if len(mesh.nodes) < _FEWEST_NODES:
            edge *= 0.75
        elif len(mesh.nodes) > _MOST_NODES:
            edge *= 1.25
        else:
            break
    if mesh is None:
        raise MeshError("volume mesh: expected an attempt")
    ratio = float(mesh.volumes.sum()) / volume
    _log.info(
        "volume mesh: %d nodes, %d tetrahedra, %.1f %% of the surface's volume",
        len(mesh.nodes),
        len(mesh.tets),
        100.0 * ratio,
    )
    if not 0.5 <= ratio <= 2.0:
        raise MeshError(
            f"volume mesh: expected about the surface's volume of {1e6 * volume:.0f} ml, "
            f"got {100.0 * ratio:.0f} % of it"
        )
    return mesh


def edge_length(volume_m3: float) -> float:
    """Length of edges, m, that gives an organ of a volume, m^3, the nodes that are wanted."""
    return float((volume_m3 / _CUBED_EDGES_PER_VOLUME) ** (1.0 / 3.0))


def clean_tets(nodes: FloatArray, tets: IntArray) -> VolumeMesh:
    """Turn tetrahedra to positive volume, drop empty ones and all but the largest connected part.

    Raises
    ------
    MeshError
        If nothing is left.
    """
    nodes, tets = np.asarray(nodes, dtype=np.float64), np.asarray(tets, dtype=np.int64)
    volumes = _signed_volumes(nodes, tets)
    solid = np.abs(volumes) > 1e-6 * np.abs(volumes).max(initial=0.0)
    tets = np.where((volumes < 0.0)[:, None], tets[:, [1, 0, 2, 3]], tets)[solid]
    if len(tets) == 0:
        raise MeshError("volume mesh: expected tetrahedra with a volume, got none")
    start, end = tets.ravel(), np.roll(tets, 1, axis=1).ravel()
    graph = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(len(nodes), len(nodes)))
    part = connected_components(graph, directed=False)[1][tets[:, 0]]
    tets = tets[part == np.bincount(part, weights=np.abs(volumes[solid])).argmax()]
    used, compact = np.unique(tets, return_inverse=True)
    return VolumeMesh(nodes[used], compact.reshape(-1, 4).astype(np.int64))


def _signed_volumes(nodes: FloatArray, tets: IntArray) -> FloatArray:
    corners = nodes[tets]
    edges = corners[:, :3] - corners[:, 3:]
    return np.asarray(np.einsum("ij,ij->i", edges[:, 0], np.cross(edges[:, 1], edges[:, 2])) / 6.0)


def _run_ftetwild(surface: SurfaceMesh, edge_m: float) -> tuple[FloatArray, IntArray]:
    # About its centre: what is far from the origin loses digits.
    centre = surface.vertices.mean(axis=0)
    with temporary_folder() as folder:
        source, target = folder / "surface.npz", folder / "tets.npz"
        np.savez(source, vertices=surface.vertices - centre, faces=surface.faces.astype(np.int32))
        program = [str(_WORKER), str(source), str(target), repr(edge_m), repr(_ENVELOPE_SHARE)]
        environment = child_environment()
        try:
            done = run_contained(program, folder, environment, _TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise MeshError(
                f"volume mesh: expected tetrahedra within {_TIMEOUT_S:.0f} s, got none for a surface of "
                f"{len(surface.faces)} triangles"
            ) from error
        try:
            if done.returncode == 0:
                with np.load(target) as result:
                    return result["nodes"] + centre, result["tets"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise MeshError(f"volume mesh: expected tetrahedra, got {type(error).__name__}") from error
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    raise MeshError(
        f"volume mesh: expected tetrahedra, got exit code {done.returncode} from fTetWild ({last})"
    )
