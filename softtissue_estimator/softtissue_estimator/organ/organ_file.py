"""Read and check `organ.yaml`; every mistake is one sentence that names the key."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.organ_entry import Entry, Source, inside_roots
from softtissue_estimator.support.files import is_file, is_inside, read_limited, real
from softtissue_estimator.support.yaml_file import kind_of, read_yaml, shown

FILE_NAME = "organ.yaml"
_KEYS = {"name", "frame", "unit", "system", "surface", "structures", "attached", "tetrahedra", "landmarks"}
UNITS_M = {"mm": 0.001, "m": 1.0}
_INDEX = re.compile(r"[+-]?[0-9]{1,18}")
_MOST_INDEX_BYTES = 16 * 2**20
_LONGEST_LANDMARK = 64
DEFAULT_COLOUR = (0.8, 0.8, 0.8, 1.0)


@dataclass(frozen=True)
class StructureEntry:
    """One entry of `structures`."""

    name: str
    kind: str
    mesh: Path
    colour: tuple[float, float, float, float]


@dataclass(frozen=True)
class AttachedEntry:
    """The key `attached`; lengths in metres.

    Parameters
    ----------
    vertices : tuple of int
        Indices of surface vertices as the surface's file numbers them.
    spheres : tuple of (centre, radius)
        m.
    touching : (mesh, distance) or None
        A mesh and how close to it, m, the surface counts as attached.
    patch : (centre, share) or None
        A point, m, and the share of the surface's area that is attached around it.
    """

    vertices: tuple[int, ...]
    spheres: tuple[tuple[tuple[float, float, float], float], ...]
    touching: tuple[Path, float] | None
    patch: tuple[tuple[float, float, float], float] | None = None


@dataclass(frozen=True)
class OrganFile:
    """Content of `organ.yaml`; paths are complete, lengths in metres.

    Parameters
    ----------
    unit : str
        'mm' or 'm', of the meshes.
    attached : AttachedEntry or None
        None if the file says nothing about it.
    system : str or None
        'LPS' or 'RAS', of the surface; None if the file says nothing about it.
    tetrahedra : Path or None
        What fills the surface; None if the file names none.
    landmarks : mapping
        Named places of the surface, m.
    """

    path: Path
    name: str
    frame: str
    unit: str
    surface: Path
    structures: tuple[StructureEntry, ...]
    attached: AttachedEntry | None
    system: str | None = None
    tetrahedra: Path | None = None
    landmarks: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    @property
    def unit_m(self) -> float:
        """Length of the unit, m."""
        return UNITS_M[self.unit]


def read_organ_file(folder: Path, roots: tuple[Path, ...] | None = None) -> OrganFile:
    """Read `organ.yaml` in a folder.

    Parameters
    ----------
    folder : Path
    roots : tuple of Path, optional
        Folders outside of which neither it nor a file that it names may lie; None for anywhere.

    Raises
    ------
    OrganError
        If it is missing or outside, is not YAML, or says something that cannot be meant.
    """
    path = folder / FILE_NAME
    if roots is not None and not is_inside(path, roots):
        raise OrganError(f"organ {folder}: expected a folder {inside_roots(roots)}, got one elsewhere")
    if not is_file(path):
        raise OrganError(f"organ {folder}: expected a folder with {FILE_NAME}, found none that can be read")
    content = read_yaml(path, OrganError)
    source = Source(path, roots)
    top = Entry(source, "", content, _KEYS)
    unit = top.text("unit", required_hint="mm or m")
    if unit not in UNITS_M:
        raise OrganError(f"{path}, unit: expected mm or m, got {shown(unit)}")
    system = None if top.value("system") is None else top.text("system").upper()
    if system not in (None, "LPS", "RAS"):
        raise OrganError(f"{path}, system: expected LPS or RAS, got {shown(system)}")
    return OrganFile(
        path=path,
        name=top.text("name", default=real(folder).name),
        frame=_frame(path, top.text("frame", default="organ")),
        unit=unit,
        surface=top.file("surface"),
        structures=tuple(_structure(source, i, item) for i, item in enumerate(top.items("structures"))),
        attached=_attached(source, top.value("attached"), UNITS_M[unit]),
        system=system,
        tetrahedra=None if top.value("tetrahedra") is None else top.file("tetrahedra"),
        landmarks=_landmarks(source, top.value("landmarks"), UNITS_M[unit]),
    )


def _frame(path: Path, frame: str) -> str:
    if frame.startswith("/"):
        # tf2 has no such frames: nothing would ever be found in one.
        raise OrganError(
            f"{path}, frame: expected a name without a leading slash, got {shown(frame)};"
            f" did you mean {shown(frame.lstrip('/'))}?"
        )
    return frame


def _structure(source: Source, index: int, content: Any) -> StructureEntry:
    entry = Entry(source, f"structures[{index}]", content, {"name", "kind", "mesh", "colour"})
    colour = DEFAULT_COLOUR
    given = entry.value("colour")
    if given is not None:
        channels = entry.numbers("colour", given, (3, 4))
        if not all(0.0 <= c <= 1.0 for c in channels):
            raise OrganError(f"{entry.where('colour')}: expected numbers from 0 to 1, got {shown(given)}")
        colour = (channels[0], channels[1], channels[2], channels[3] if len(channels) == 4 else 1.0)
    return StructureEntry(entry.text("name"), entry.text("kind", default="other"), entry.file("mesh"), colour)


def _landmarks(source: Source, content: Any, unit_m: float) -> dict[str, tuple[float, float, float]]:
    if content is None:
        return {}
    where = f"{source.path}, landmarks"
    if not isinstance(content, Mapping) or not content:
        raise OrganError(f"{where}: expected names with three numbers each, got {shown(content)}")
    entry = Entry(source, "landmarks", content, set(content))
    found = {}
    for name, value in content.items():
        if not isinstance(name, str) or not name.strip() or len(name) > _LONGEST_LANDMARK:
            raise OrganError(
                f"{where}: expected names of 1 to {_LONGEST_LANDMARK} letters, got {shown(name)}"
            )
        x, y, z = entry.numbers(name, value, (3,))
        found[name.strip()] = (x * unit_m, y * unit_m, z * unit_m)
    return found


def _attached(source: Source, content: Any, unit_m: float) -> AttachedEntry | None:
    if content is None:
        return None
    entry = Entry(source, "attached", content, {"vertices", "spheres", "touching", "patch"})
    spheres = []
    for i, item in enumerate(entry.items("spheres")):
        sphere = Entry(source, f"attached.spheres[{i}]", item, {"centre", "radius"})
        x, y, z = sphere.numbers("centre", sphere.value("centre"), (3,))
        radius = sphere.positive("radius")
        spheres.append(((x * unit_m, y * unit_m, z * unit_m), radius * unit_m))
    touching = None
    if entry.value("touching") is not None:
        touch = Entry(source, "attached.touching", entry.value("touching"), {"mesh", "distance"})
        touching = (touch.file("mesh"), touch.positive("distance") * unit_m)
    patch = None
    if entry.value("patch") is not None:
        piece = Entry(source, "attached.patch", entry.value("patch"), {"centre", "share"})
        x, y, z = piece.numbers("centre", piece.value("centre"), (3,))
        share = piece.positive("share")
        if share >= 1.0:
            raise OrganError(
                f"{piece.where('share')}: expected a share of the surface below 1, got {share:g}"
            )
        patch = ((x * unit_m, y * unit_m, z * unit_m), share)
    return AttachedEntry(_vertex_indices(entry), tuple(spheres), touching, patch)


def _vertex_indices(entry: Entry) -> tuple[int, ...]:
    given = entry.value("vertices")
    if given is None:
        return ()
    where = entry.where("vertices")
    tokens: list[Any]
    if isinstance(given, str):
        file = entry.file("vertices")
        try:
            tokens = read_limited(file, _MOST_INDEX_BYTES).decode("utf-8-sig").split()
        except (OSError, ValueError) as error:
            why = "one that is not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
            raise OrganError(f"{where}: expected a text file of indices, got {why}: {file}") from error
    elif isinstance(given, list):
        tokens = given
    else:
        raise OrganError(f"{where}: expected a file name or a list of indices, got {kind_of(given)}")
    indices = []
    for number, token in enumerate(tokens, 1):
        # The token itself is not repeated: the file may be any that can be read.
        if isinstance(token, bool) or not _INDEX.fullmatch(str(token)):
            raise OrganError(
                f"{where}: expected whole numbers of at most 18 digits, got something else as entry {number}"
            )
        indices.append(int(token))
    return tuple(indices)
