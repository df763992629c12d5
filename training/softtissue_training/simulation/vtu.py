"""Simulations as VTU files, for ParaView."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np

from softtissue_training.simulation.sample import Record


def write_vtu(folder: Path, record: Record) -> list[Path]:
    """Write one file a load case, `organ_000007_case_0.vtu`; returns their paths.

    Points are preoperative, metres; point data are `displacement` (m), `force` (N) and `attached`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for sample in record.simulations:
        attached = np.zeros(len(sample.vertices), dtype=np.uint8)
        attached[sample.attached] = 1
        mesh = meshio.Mesh(
            sample.vertices,
            [("tetra", sample.tets)],
            point_data={"displacement": sample.displacement, "force": sample.force, "attached": attached},
        )
        path = folder / f"organ_{sample.seed[1]:06d}_case_{sample.case}.vtu"
        mesh.write(path)
        paths.append(path)
    return paths
