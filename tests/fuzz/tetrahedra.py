"""Damaged tetrahedra as `check_organ --tetrahedra` writes them, named by an organ that is in order."""

import random
from pathlib import Path

import numpy as np
import trimesh
import yaml

from estimator.shapes import box_tets
from fuzz.damage import damaged_bytes, damaged_text
from fuzz.kind import Kind, expect
from fuzz.meshes import check_organ
from softtissue_estimator.organ.mesh_files.plain_vtu import plain_vtu
from softtissue_estimator.organ.organ import load_organ

_FILLED = box_tets((80.0, 60.0, 40.0), (5, 4, 4))
_FILE = "tets.vtu"


class Tetrahedra(Kind):
    """VTU of plain text."""

    name = "tetrahedra"
    share = 6

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._content = plain_vtu(_FILLED.nodes, _FILLED.tets, 6).encode()
        box = trimesh.Trimesh(_FILLED.nodes, _FILLED.boundary_faces, process=True)
        (folder / "organ.ply").write_bytes(box.export(file_type="ply"))
        (folder / _FILE).write_bytes(self._content)
        attached = {"spheres": [{"centre": [0, 0, 0], "radius": 30}]}
        content = {"unit": "mm", "surface": "organ.ply", "attached": attached, "tetrahedra": _FILE}
        (folder / "organ.yaml").write_text(yaml.safe_dump(content))
        self._digest = load_organ(folder).digest

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        damaged = damaged_text if rng.random() < 0.7 else damaged_bytes
        return _FILE, damaged(rng, self._content)

    def run(self, name: str, content: bytes) -> str:
        (self.folder / name).write_bytes(content)
        organ = load_organ(self.folder)
        check_organ(organ)
        mesh = organ.tetrahedra
        expect(mesh is not None, "no tetrahedra, although some are named")
        expect(
            bool(np.isfinite(mesh.nodes).all() and (mesh.volumes > 0.0).all()), "flat or inverted elements"
        )
        expect(0.9 <= mesh.volumes.sum() / (0.08 * 0.06 * 0.04) <= 1.1, "another volume than the organ's")
        return "read"

    def check_good(self) -> None:
        (self.folder / _FILE).write_bytes(self._content)
        expect(load_organ(self.folder).digest == self._digest, "undamaged tetrahedra are read as other ones")
