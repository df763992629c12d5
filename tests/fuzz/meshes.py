"""Damaged mesh files, as an organ's surface and as a structure inside it."""

import importlib.util
import json
import os
import random
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fuzz.damage import damaged_bytes, damaged_text, rewritten_text
from fuzz.kind import Kind, MissingError, expect
from fuzz.mesh_templates import choose, organ_yaml, templates
from softtissue_estimator.organ.mesh_files import cells_worker, isolated
from softtissue_estimator.organ.organ import Organ, load_organ

_SAME = "same-"  # begins the names of files that are written otherwise but mean the same
_TEXT = ("text", "plain", "textured", "ascii")
_THROUGH_LIBRARY = (".vtk", ".vtp", ".vtu", ".msh")
_WHOLE_WAY_SHARE = 0.01


class Meshes(Kind):
    """Files of the formats that the product reads itself: OBJ, PLY and STL."""

    name = "meshes"
    share = 40
    suffixes: tuple[str, ...] = (".obj", ".ply", ".stl")
    _rewritten_share = 0.05

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._templates = {name: data for name, data in templates().items() if name.endswith(self.suffixes)}
        missing = set(self.suffixes) - {Path(name).suffix for name in self._templates}
        if missing:
            raise MissingError(f"the library for {', '.join(sorted(missing))} is not installed")
        plain = templates()["binary.ply"]
        for role in ("surface", "structure"):
            for suffix in self.suffixes:
                place = folder / f"{role}{suffix.replace('.', '_')}"
                place.mkdir()
                (place / "organ.ply").write_bytes(plain)
                surface, structures = (
                    (f"mesh{suffix}", ()) if role == "surface" else ("organ.ply", (("a", f"mesh{suffix}"),))
                )
                (place / "organ.yaml").write_text(organ_yaml(surface, structures))
        self._good = {
            name: self._load("surface", name, data).digest for name, data in self._templates.items()
        }

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name = choose(rng, sorted(self._templates))
        content, is_text = self._templates[name], name.startswith(_TEXT)
        if is_text and rng.random() < self._rewritten_share:
            return f"surface-{_SAME}{name}", rewritten_text(rng, content)
        damaged = damaged_text if is_text and rng.random() < 0.7 else damaged_bytes
        return f"{rng.choice(('surface', 'surface', 'surface', 'structure'))}-{name}", damaged(rng, content)

    def run(self, name: str, content: bytes) -> str:
        role, _, template = name.partition("-")
        if template.startswith(_SAME):
            organ = self._load(role, template, content)
            expect(
                organ.digest == self._good[template.removeprefix(_SAME)],
                "written otherwise it is another organ",
            )
            return "the same"
        check_organ(self._load(role, template, content))
        return "read"

    def check_good(self) -> None:
        for name, digest in self._good.items():
            found = self._load("surface", name, self._templates[name]).digest
            expect(found == digest, f"the undamaged {name} is read as another organ")

    def _load(self, role: str, template: str, content: bytes) -> Organ:
        place = self.folder / f"{role}{Path(template).suffix.replace('.', '_')}"
        (place / f"mesh{Path(template).suffix}").write_bytes(content)
        return load_organ(place)


class LibraryMeshes(Meshes):
    """Files that VTK and meshio read, in a process of its own each.

    To start one takes half a second. Here a process that has the libraries already branches off one for each file,
    which is bounded and ends as those of the product do; one file of a hundred goes the whole way.
    """

    name = "library meshes"
    share = 12
    suffixes = _THROUGH_LIBRARY
    _rewritten_share = 0.0

    def __init__(self, folder: Path) -> None:
        if importlib.util.find_spec("vtkmodules") is None or importlib.util.find_spec("meshio") is None:
            raise MissingError("VTK or meshio is not installed")
        self._whole_way, self._branching = isolated.run_contained, Branching()
        self._way: Callable[..., subprocess.CompletedProcess[str]] = self._branching
        isolated.run_contained = lambda *arguments: self._way(*arguments)
        super().__init__(folder)

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name, content = super().make(rng)
        return (
            (f"{name.partition('-')[0]}-whole-way-{name.partition('-')[2]}", content)
            if (rng.random() < _WHOLE_WAY_SHARE)
            else (name, content)
        )

    def run(self, name: str, content: bytes) -> str:
        self._way = self._whole_way if "whole-way" in name else self._branching
        try:
            return super().run(name, content)
        finally:
            self._way = self._branching

    def close(self) -> None:
        isolated.run_contained = self._whole_way
        self._branching.close()


def check_organ(organ: Organ) -> None:
    """Raise FailedError if an organ that was read cannot be one."""
    for mesh in (organ.surface, *(structure.mesh for structure in organ.structures)):
        expect(bool(np.isfinite(mesh.vertices).all()), "vertices that are not finite")
        expect(len(mesh.faces) > 0 and int(mesh.faces.max()) < len(mesh.vertices), "faces of no vertices")
    expect(not organ.attached.all(), "attached everywhere")
    expect(float(np.ptp(organ.surface.vertices, axis=0).max()) <= 1.0, "an organ of more than a metre")


class Branching:
    """Reads files as `run_contained` lets `cells_worker` do, in processes that `branching_reader` branches off."""

    def __init__(self) -> None:
        program = [
            sys.executable,
            str(Path(__file__).with_name("branching_reader.py")),
            cells_worker.__file__,
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def __call__(
        self, program: Sequence[str], folder: Path, environment: Mapping[str, str], timeout_s: float
    ) -> "subprocess.CompletedProcess[str]":
        """Do what `run_contained` does."""
        requests, answers = self._process.stdin, self._process.stdout
        if requests is None or answers is None:
            raise MissingError("the reader of files is gone")
        printed = folder / "printed"
        requests.write(json.dumps([list(program), str(printed), timeout_s]) + "\n")
        requests.flush()
        answer = answers.readline().strip()
        if answer == "late":
            raise subprocess.TimeoutExpired(list(program), timeout_s)
        text = printed.read_text(errors="replace") if printed.exists() else ""
        return subprocess.CompletedProcess(list(program), int(answer), "", text)

    def close(self) -> None:
        """End it."""
        if self._process.stdin is not None and self._process.stdout is not None:
            self._process.stdin.close()
            self._process.wait(10.0)
            self._process.stdout.close()
