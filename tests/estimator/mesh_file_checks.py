"""Meshes that are written in some format, what must be read of them, and damaged copies."""

import numpy as np
import pytest
import trimesh

from estimator.shapes import box_tets, ellipsoid
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import enclosed_volume
from softtissue_estimator.organ.mesh_io import read_mesh

MM = 1e-3


LIVER = ellipsoid((0.09, 0.06, 0.05), subdivisions=2)


BOX = box_tets()


def check_surface(found, atol=1e-7):
    """Tell that what was read is LIVER, its vertices in their order."""
    np.testing.assert_allclose(found.mesh.vertices, LIVER.vertices, atol=atol)
    np.testing.assert_array_equal(found.mesh.faces, LIVER.faces)
    np.testing.assert_array_equal(found.vertex_of_stored, np.arange(len(LIVER.vertices)))


def check_volume(found, points_mm, volume_mm3, atol=1e-7):
    """Tell that what was read is the closed, outward surface of a volume mesh, its vertices known by their number."""
    mesh, stored = found.mesh, found.vertex_of_stored
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert enclosed_volume(mesh) == pytest.approx(1e-9 * volume_mm3, rel=1e-5)
    assert len(stored) == len(points_mm)
    assert (stored >= 0).sum() == len(mesh.vertices) < len(points_mm)
    np.testing.assert_allclose(mesh.vertices[stored[stored >= 0]], MM * points_mm[stored >= 0], atol=atol)


def content_of(kind: str) -> bytes:
    ball = trimesh.Trimesh(LIVER.vertices / MM, LIVER.faces, process=False)
    data = ball.export(file_type=kind.split()[0], **({"encoding": "ascii"} if kind == "ply text" else {}))
    return data if isinstance(data, bytes) else data.encode()


def damaged(whole: bytes, cuts: int, flips: int):
    """Yield beginnings of a file and copies with flipped bits, half of these near the beginning."""
    rng = np.random.default_rng(5)
    for end in rng.integers(1, len(whole), size=cuts):
        yield whole[:end]
    for i in range(flips):
        content = bytearray(whole)
        for place in rng.integers(len(content) if i % 2 else min(300, len(content)), size=1 + i % 5):
            content[place] ^= 1 << int(rng.integers(8))
        yield bytes(content)


def outcome(path, content: bytes) -> str:
    path.write_bytes(content)
    try:
        mesh = read_mesh(path, MM).mesh
    except MeshError as error:
        return "one sentence" if path.name in str(error) and "\n" not in str(error) else f"bad: {error}"
    return "mesh" if np.isfinite(mesh.vertices).all() and len(mesh.faces) else "bad mesh"
