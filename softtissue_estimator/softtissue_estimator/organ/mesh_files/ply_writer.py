"""Write a surface as a binary PLY file that states its coordinate system."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_files.coordinate_system import signs_between


def write_ply(path: Path, mesh: SurfaceMesh, unit_m: float, system: str) -> None:
    """Write a surface in a unit (its length in m) and in 'LPS' or 'RAS', which the header states.

    Parameters
    ----------
    mesh : SurfaceMesh
        m, LPS.

    Raises
    ------
    MeshError
        If the file cannot be written.
    """
    points = (mesh.vertices * signs_between("LPS", system) / unit_m).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment SPACE={system}\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    try:
        path.write_bytes(header.encode("ascii") + points.tobytes() + faces.tobytes())
    except OSError as error:
        raise MeshError(
            f"mesh {path}: expected a file that can be written, got '{error.strerror}'"
        ) from error
