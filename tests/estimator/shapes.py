"""Simple bodies with known geometry."""

import itertools
from pathlib import Path

import meshio
import numpy as np
import trimesh

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ, make_organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh, clean_tets


def sphere(radius: float = 0.05, centre=(0.0, 0.0, 0.0), subdivisions: int = 4) -> SurfaceMesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return SurfaceMesh(np.asarray(ball.vertices) + centre, np.asarray(ball.faces))


def ellipsoid(half_axes=(0.07, 0.05, 0.04), subdivisions: int = 4) -> SurfaceMesh:
    unit = sphere(1.0, subdivisions=subdivisions)
    return SurfaceMesh(unit.vertices * np.asarray(half_axes), unit.faces)


def ellipsoid_tets(half_axes) -> VolumeMesh:
    """Half the nodes that an organ is filled with, the same in every run: answers take a fraction of the time.

    fTetWild filled the unit sphere, with edges of 0.28.
    """
    with np.load(Path(__file__).parents[1] / "data" / "ball.npz") as ball:
        return clean_tets(ball["nodes"].astype(np.float64) * half_axes, ball["tets"].astype(np.int64))


def write_ellipsoid_tets(path: Path, half_axes) -> None:
    """The same as a file, for an organ folder to name; in the unit of the half-axes."""
    mesh = ellipsoid_tets(half_axes)
    meshio.Mesh(mesh.nodes, {"tetra": mesh.tets}).write(path)


def box_tets(lengths=(0.04, 0.03, 0.02), cells=(4, 3, 2)) -> VolumeMesh:
    """Box from the origin, each cell cut into the six tetrahedra along its diagonal."""
    axes = [np.linspace(0.0, length, n + 1) for length, n in zip(lengths, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    tets = []
    for cell in itertools.product(*(range(n) for n in cells)):
        for order in itertools.permutations(range(3)):
            corner = np.array(cell)
            path = [number[tuple(corner)]]
            for axis in order:
                corner[axis] += 1
                path.append(number[tuple(corner)])
            tets.append(path)
    return clean_tets(nodes, np.array(tets))


def organ_of(surface: SurfaceMesh, attached=None, tetrahedra: VolumeMesh | None = None) -> Organ:
    flags = np.zeros(len(surface.vertices), dtype=bool) if attached is None else attached
    return make_organ("test organ", "organ", surface, (), flags, tetrahedra=tetrahedra)


def rotation(axis, angle_rad: float) -> np.ndarray:
    """Rotation matrix by Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
