"""Tetrahedra that an organ folder names, so that the same organ has the same ones on every machine; and their file."""

from __future__ import annotations

import math
from pathlib import Path

import igl
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh, enclosed_volume, sample_faces
from softtissue_estimator.organ.mesh_files.cell_surface import VOLUME_SHAPES, MeshCells
from softtissue_estimator.organ.mesh_files.plain_vtu import plain_vtu
from softtissue_estimator.organ.mesh_io import read_cells
from softtissue_estimator.organ.organ_checks import mirror_hint, share_inside
from softtissue_estimator.organ.volume_mesh import VolumeMesh

SUFFIX = ".vtu"
_FEWEST_NODES, _MOST_NODES = 100, 2000  # fewer resolve no bending; matrices of an answer have 3 n rows
_FLATTEST = 1e-4  # least volume over the cube of the longest edge; 0.12 is regular
_VOLUME_MARGIN = 0.1  # of the surface's volume
_DISTANCE_SHARE = 0.03  # of the diagonal of the bounding box, between the boundary and the surface
_SAMPLE_SHARE = 0.02  # of that diagonal, between samples of both
_WRITTEN_M = 1e-9  # coordinates are rounded to this


def read_tetrahedra(path: Path, unit_m: float, system: str | None, surface: SurfaceMesh) -> VolumeMesh:
    """Read the tetrahedra of an organ and check that they are fit for it.

    Parameters
    ----------
    path : Path
        Any format of `read_mesh` that holds tetrahedra; of those of higher order the corners are used.
    unit_m : float
        Length of the file's unit, m.
    system : str or None
        Coordinate system of the organ; a file that states another one is converted.
    surface : SurfaceMesh
        Of the organ, m.

    Raises
    ------
    MeshError
        If the file cannot be read, or as of `check_tetrahedra`.
    """
    cells = read_cells(path, system)
    try:
        # What overflows is no volume that is accepted.
        with np.errstate(all="ignore"):
            mesh = _volume_mesh(cells, unit_m)
            check_tetrahedra(mesh, surface)
    except MeshError as error:
        raise MeshError(f"tetrahedra {path}: {error}") from error
    return mesh


def write_tetrahedra(path: Path, mesh: VolumeMesh, unit_m: float, surface: SurfaceMesh) -> None:
    """Write tetrahedra as text in a VTU file, which needs no VTK library to be read again; arguments as above.

    Raises
    ------
    MeshError
        If `read_tetrahedra` would refuse them, or the file cannot be written.
    """
    try:
        check_tetrahedra(mesh, surface)
    except MeshError as error:
        raise MeshError(f"tetrahedra {path}: {error}") from error
    decimals = round(math.log10(unit_m / _WRITTEN_M))
    try:
        path.write_text(plain_vtu(mesh.nodes / unit_m, mesh.tets, decimals), encoding="ascii")
    except OSError as error:
        raise MeshError(
            f"tetrahedra {path}: expected a file that can be written, got '{error.strerror}'"
        ) from error


def check_tetrahedra(mesh: VolumeMesh, surface: SurfaceMesh) -> None:
    """Check that tetrahedra are one sound body that fills a surface, m.

    Raises
    ------
    MeshError
        If they are too few or too many, flat or inverted, stored twice, not one body, or not that of the surface:
        volume within 10 %, boundary and surface within 3 % of the diagonal of its bounding box of each other.
    """
    if not _FEWEST_NODES <= len(mesh.nodes) <= _MOST_NODES:
        raise MeshError(
            f"expected {_FEWEST_NODES} to {_MOST_NODES} nodes (500 to 900 are best), got {len(mesh.nodes)}"
        )
    _check_elements(mesh)
    volume = enclosed_volume(surface)
    ratio = float(mesh.volumes.sum()) / volume
    if abs(ratio - 1.0) > _VOLUME_MARGIN:
        raise MeshError(
            f"expected the surface's volume of {1e6 * volume:.4g} ml to {100.0 * _VOLUME_MARGIN:g} %, "
            f"got {1e6 * ratio * volume:.4g} ml{_unit_hint(ratio)}"
        )
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    distance = _farthest(SurfaceMesh(mesh.nodes, mesh.boundary_faces), surface, _SAMPLE_SHARE * diagonal)
    if distance > _DISTANCE_SHARE * diagonal:
        centroids = mesh.nodes[mesh.tets].mean(axis=1)
        hint = mirror_hint(surface, centroids, share_inside(surface, centroids))
        raise MeshError(
            f"expected a boundary within {1e3 * _DISTANCE_SHARE * diagonal:.1f} mm of the organ's surface, "
            f"got {1e3 * distance:.1f} mm between them{hint}"
        )


def _unit_hint(ratio: float) -> str:
    exponent = math.log10(ratio)
    return "; they are probably in another unit than the organ" if abs(abs(exponent) - 9.0) < 0.3 else ""


def _volume_mesh(cells: MeshCells, unit_m: float) -> VolumeMesh:
    """Turn cells to tetrahedra of positive volume, m; nodes that none uses are dropped."""
    volumes = [block for block in cells.blocks if block.shape in VOLUME_SHAPES and len(block.nodes)]
    others = sorted({block.shape for block in volumes} - {"tetra"})
    if others or not volumes:
        raise MeshError(
            f"expected tetrahedra, got {'also cells of kind ' + ', '.join(others) if others else 'a surface'}"
        )
    used, compact = np.unique(np.concatenate([block.nodes[:, :4] for block in volumes]), return_inverse=True)
    nodes = cells.points[used] * unit_m
    bad = int((~np.isfinite(nodes).all(axis=1)).sum())
    if bad:
        raise MeshError(f"expected finite coordinates, got {bad} nodes with NaN or inf")
    tets = compact.reshape(-1, 4).astype(np.int64)
    mesh = VolumeMesh(nodes, tets)
    # Formats differ in how they number the nodes of a cell, within a file there is one way.
    return VolumeMesh(nodes, tets[:, [1, 0, 2, 3]]) if np.median(mesh.volumes) < 0.0 else mesh


def _check_elements(mesh: VolumeMesh) -> None:
    """Raise MeshError unless tetrahedra have a volume and hang together at their faces, two at each."""
    corners = mesh.nodes[mesh.tets]
    pairs = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
    longest = np.linalg.norm(pairs, axis=2).max(axis=1)
    bad = int((~(mesh.volumes > _FLATTEST * longest**3)).sum())
    if bad:
        raise MeshError(
            f"expected tetrahedra of positive volume, got {bad} of {len(mesh.tets)} flat or inverted"
        )
    owner, face = _owners(mesh.tets)
    if np.bincount(face).max() > 2:
        raise MeshError("expected at most two tetrahedra at a face, got one with more")
    shared = np.flatnonzero(face[1:] == face[:-1])
    links = (np.ones(len(shared), dtype=np.int8), (owner[shared], owner[shared + 1]))
    count = connected_components(coo_array(links, shape=(len(mesh.tets),) * 2), directed=False)[0]
    if count > 1:
        raise MeshError(f"expected one body whose tetrahedra share faces, got {count}")


def _owners(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Tetrahedron and number of every face of each, (4 m,) both; the same face in a row."""
    faces = np.sort(tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    number = np.unique(faces, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(number, kind="stable")
    return order // 4, number[order]


def _farthest(one: SurfaceMesh, other: SurfaceMesh, spacing_m: float) -> float:
    """Largest distance of a sample of one surface from the other one, m, either way."""
    return max(_reach(one, other, spacing_m), _reach(other, one, spacing_m))


def _reach(source: SurfaceMesh, target: SurfaceMesh, spacing_m: float) -> float:
    points: FloatArray = np.concatenate(
        [source.vertices[np.unique(source.faces)], sample_faces(source, None, spacing_m)[0]]
    )
    squared = igl.point_mesh_squared_distance(points, target.vertices, target.faces)[0]
    return float(np.sqrt(np.max(squared)))
