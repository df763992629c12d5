"""Damaged organ and case files."""

import json
import random
from pathlib import Path

import trimesh
import yaml

from fuzz.damage import damaged_text, damaged_tree
from fuzz.kind import Kind, expect
from fuzz.mesh_templates import templates
from fuzz.meshes import check_organ
from softtissue_estimator.organ.organ import load_organ
from softtissue_training.experiments.breathing.case import load_case
from softtissue_training.experiments.phantom.case_file import read_case_file

_NUMBERS = [0, 17, 3, 99]
ORGAN = {
    "name": "Liver",
    "frame": "scan",
    "unit": "mm",
    "system": "LPS",
    "surface": "organ.ply",
    "structures": [{"name": "tumour", "kind": "tumour", "mesh": "organ.ply", "colour": [1, 0.5, 0]}],
    "attached": {
        "vertices": _NUMBERS,
        "spheres": [{"centre": [90, 0, 0], "radius": 25.5}],
        "touching": {"mesh": "touching.ply", "distance": 12.0},
        "patch": {"centre": [-90, 0, 0], "share": 0.05},
    },
}
LISTED = ORGAN | {"attached": {"vertices": "numbers.txt"}}
BREATHING = {
    "name": "breath",
    "unit": "mm",
    "anterior": [0, -1, 0],
    "surface_after": "organ.ply",
    "structures_after": [{"name": "tumour", "mesh": "organ.ply"}],
    "alignment": "none",
}
PHANTOM = {
    "name": "phantom",
    "unit": "mm",
    "system": "RAS",
    "sigma": 0.5,
    "markers": {"before": "points.csv", "after": "points.csv"},
    "correspondences": {"before": "points.csv", "after": "points.csv"},
    "surface_after": "organ.ply",
    "visible": {"centre": [0, 0, 50], "share": 0.2},
    "tracking_noise": 0.2,
}
# What no tree of plain values can say.
_SNIPPETS = (
    "name: &a [*a]\n", "a: &a [x, x]\nb: &b [*a, *a]\nname: *b\n", "name: !!python/object/apply:os.system [true]\n",
    "<<: {unit: m}\n", "? [1, 2]\n: x\n", "name: 2024-02-30\n", "name: 1:2:3:4\n", "name: !!binary aGVsbG8=\n",
    "%YAML 9.9\n---\n", "---\n---\n", "name: !!set {a, b}\n", "unit: mm\nunit: m\n", "name: |\n  a\n", "name: 0b1\n",
    "[" * 3000, "{a: " * 100, "name: 'x\n", "\t- a\n", "name: .inf\n", "surface: ~\n", "name: " + "9" * 400 + "\n",
    "name: !<tag:yaml.org,2002:timestamp> x\n", "name: = \n", "name: !!int x\n", "name: !!float ''\n",
)  # fmt: skip


class YamlFiles(Kind):
    """`organ.yaml`, lists of vertices beside it, and the `case.yaml` of both experiments."""

    name = "yaml files"
    share = 14

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for name in ("organ", "listed", "breathing", "phantom"):
            place = folder / name
            place.mkdir()
            (place / "organ.ply").write_bytes(templates()["binary.ply"])
            (place / "touching.ply").write_bytes(
                trimesh.creation.icosphere(2, 10.0).apply_translation([0, 55, 0]).export(file_type="ply")
            )
            (place / "points.csv").write_text("label,x,y,z\na,1,2,3\n")
            (place / "numbers.txt").write_text("\n".join(map(str, _NUMBERS)))
            (place / "organ.yaml").write_text(yaml.safe_dump(LISTED if name == "listed" else ORGAN))
        self._digests = [load_organ(folder / name).digest for name in ("organ", "listed")]

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        name, tree = rng.choice(
            (
                ("organ.yaml", ORGAN),
                ("organ.yaml", ORGAN),
                ("organ.yaml", LISTED),
                ("breathing.yaml", BREATHING),
                ("phantom.yaml", PHANTOM),
                ("numbers.txt", None),
            )
        )
        if tree is None:
            return name, damaged_text(rng, "\n".join(map(str, _NUMBERS * 10)).encode())
        what = rng.random()
        if what < 0.5:
            text = dumped(damaged_tree(rng, tree), rng)
        else:
            text = yaml.safe_dump(tree).encode()
        if what > 0.4:
            text = damaged_text(rng, text)
        if rng.random() < 0.1:
            snippet = rng.choice(_SNIPPETS).encode()
            text = snippet + text if rng.random() < 0.5 else text + snippet
        return name, text

    def run(self, name: str, content: bytes) -> str:
        kind = {"organ.yaml": "organ", "numbers.txt": "listed"}.get(name, Path(name).stem)
        file = self.folder / kind / (name if name in ("organ.yaml", "numbers.txt") else "case.yaml")
        before = file.read_bytes() if file.exists() else None
        file.write_bytes(content)
        try:
            if kind == "breathing":
                check_organ(load_case(file.parent).organ)
            elif kind == "phantom":
                expect(read_case_file(file.parent, "mm").unit_m > 0.0, "a unit without length")
            else:
                check_organ(load_organ(file.parent))
        finally:
            if before is not None:
                file.write_bytes(before)
        return "read"

    def check_good(self) -> None:
        found = [load_organ(self.folder / name).digest for name in ("organ", "listed")]
        expect(found == self._digests, "the undamaged organ is read as another one")
        for name, tree in (("breathing", BREATHING), ("phantom", PHANTOM)):
            (self.folder / name / "case.yaml").write_text(yaml.safe_dump(tree))
        expect(
            load_case(self.folder / "breathing").name == "breath", "the undamaged case is read as another one"
        )
        expect(
            read_case_file(self.folder / "phantom", "mm").sigma_m == 0.0005,
            "the undamaged case is another one",
        )


def dumped(tree: object, rng: random.Random) -> bytes:
    """Write a tree as YAML, whatever is in it."""
    if rng.random() < 0.5:
        return json.dumps(tree, default=str, skipkeys=True).encode(errors="replace")
    try:
        return yaml.dump(tree, allow_unicode=rng.random() < 0.5).encode(errors="surrogatepass")
    except Exception:  # lone surrogates, which only JSON can escape
        return json.dumps(tree, default=str, skipkeys=True).encode()
