"""Write a bumpy ball of two million triangles in each format that is read here, and say how long reading takes.

As a program: `python tests/estimator/organ/time_large_meshes.py` (about a gigabyte in a temporary folder).
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[3] / "softtissue_estimator"))

from softtissue_estimator.organ.mesh_io import read_mesh


def ball(triangles: int) -> trimesh.Trimesh:
    """Ball of about so many triangles between circles of latitude, mm."""
    rows = int(np.sqrt(triangles / 4))
    around, down = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, 2 * rows, endpoint=False), np.linspace(0.0, np.pi, rows + 2)[1:-1]
    )
    radius = 1.0 + 0.05 * np.sin(7.0 * around) * np.sin(5.0 * down)
    sides = [90.0 * np.sin(down) * np.cos(around), 60.0 * np.sin(down) * np.sin(around), 50.0 * np.cos(down)]
    vertices = (radius[..., None] * np.stack(sides, axis=-1)).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(2 * rows), indexing="ij")
    first, second = row * 2 * rows + column, row * 2 * rows + (column + 1) % (2 * rows)
    quads = [[first, first + 2 * rows, second], [second, first + 2 * rows, second + 2 * rows]]
    faces = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in quads]
    ring, last = np.arange(2 * rows), len(vertices) - 2 * rows
    top, bottom = np.full(2 * rows, len(vertices)), np.full(2 * rows, len(vertices) + 1)
    faces.append(np.stack([top, ring, np.roll(ring, -1)], axis=1))
    faces.append(np.stack([bottom, last + np.roll(ring, -1), last + ring], axis=1))
    poles = [[0.0, 0.0, 50.0], [0.0, 0.0, -50.0]]
    return trimesh.Trimesh(np.concatenate([vertices, poles]), np.concatenate(faces), process=False)


def main() -> None:
    """Write, read and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--triangles", type=int, default=2_000_000)
    mesh = ball(parser.parse_args().triangles)
    contents = {
        "binary.ply": lambda: mesh.export(file_type="ply"),
        "text.ply": lambda: mesh.export(file_type="ply", encoding="ascii"),
        "binary.stl": lambda: mesh.export(file_type="stl"),
        "text.stl": lambda: mesh.export(file_type="stl_ascii"),
        "text.obj": lambda: mesh.export(file_type="obj", include_normals=False),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, content in contents.items():
            path, data = Path(folder) / name, content()
            path.write_bytes(data if isinstance(data, bytes) else data.encode())
            del data
            began, busy = time.monotonic(), time.process_time()
            read = read_mesh(path, 1e-3).mesh
            print(
                f"{name}: {len(mesh.faces)} triangles read as {len(read.faces)} in {time.monotonic() - began:.1f} s,"
                f" {time.process_time() - busy:.1f} s of the processor",
                flush=True,
            )
            path.unlink()


if __name__ == "__main__":
    main()
