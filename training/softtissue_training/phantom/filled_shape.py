"""Tetrahedra of an implicit solid: fine ones for its motion, coarse ones that its folder names; the same every time."""

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.volume_mesh import VolumeMesh, clean_tets
from softtissue_training.organs.tetrahedralise import TetMesh, tetrahedralise
from softtissue_training.phantom.isosurface import isosurface
from softtissue_training.phantom.liver_shape import LiverShape


def fill(shape: LiverShape, size: float) -> TetMesh:
    """Fill a solid with tetrahedra of about `size` (m); a little smaller ones where some would be too flat.

    Raises
    ------
    MeshError
        If it cannot be filled.
    """
    for factor in (1.0, 0.96, 0.92):
        try:
            surface = isosurface(shape, *shape.box, factor * size)
            return tetrahedralise(surface, 1.2 * factor * size)
        except MeshError as error:
            problem = error
    raise problem


def coarse_tetrahedra(shape: LiverShape, size: float) -> VolumeMesh:
    """Fill a solid as coarsely as the estimator would (`size` in m), but with Gmsh, which draws nothing at random."""
    mesh = fill(shape, size)
    return clean_tets(mesh.vertices, mesh.tets)
