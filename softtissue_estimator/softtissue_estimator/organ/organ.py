"""An organ as scanned: its surface, what lies inside it and where it is attached."""

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import igl
import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.mesh import (
    BoolArray,
    FloatArray,
    IntArray,
    SurfaceMesh,
)
from softtissue_estimator.organ.mesh_io import StoredMesh, read_mesh
from softtissue_estimator.organ.organ_checks import check_landmarks, check_place, check_size, mirror_hint
from softtissue_estimator.organ.organ_file import OrganFile, StructureEntry, read_organ_file
from softtissue_estimator.organ.stray_vertices import warn_of_stray_vertices
from softtissue_estimator.organ.surface_lookup import SurfaceLookup, build_surface_lookup
from softtissue_estimator.organ.surface_patch import patch
from softtissue_estimator.organ.surface_repair import check_closed, clean_organ_surface
from softtissue_estimator.organ.tetrahedra_file import read_tetrahedra
from softtissue_estimator.organ.volume_mesh import VolumeMesh

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Structure:
    """Something inside the organ, such as a vessel tree or a tumour.

    Parameters
    ----------
    name, kind : str
    mesh : SurfaceMesh
        m, organ frame.
    colour : tuple of four floats
        Red, green, blue, opacity; 0 to 1.
    """

    name: str
    kind: str
    mesh: SurfaceMesh
    colour: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Organ:
    """A preoperative organ. Everything is in metres, in the frame named `frame`.

    Parameters
    ----------
    name, frame : str
    surface : SurfaceMesh
    structures : tuple of Structure
    attached : (n,) bool
        For every surface vertex, whether it is held in place.
    folder : Path or None
        Where it was read from.
    digest : str
        Hash of geometry, attachment, structures and tetrahedra; equal digests mean equal organs.
    system : str or None
        Coordinate system that its files state, 'LPS' or 'RAS' say; None if they state none.
    tetrahedra : VolumeMesh or None
        What fills it, where its folder says so; None leaves them to whoever needs them.
    landmarks : mapping
        Places of the surface by name, (3,) m.
    """

    name: str
    frame: str
    surface: SurfaceMesh
    structures: tuple[Structure, ...]
    attached: BoolArray
    folder: Path | None
    digest: str
    system: str | None = None
    tetrahedra: VolumeMesh | None = None
    landmarks: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.attached.shape != (len(self.surface.vertices),):
            raise OrganError(
                f"organ {self.name!r}, attached: expected one flag for each of the "
                f"{len(self.surface.vertices)} surface vertices, got shape {self.attached.shape}"
            )

    @cached_property
    def centre(self) -> FloatArray:
        """Mean of the surface vertices, (3,) m: about which errors of a registration are counted."""
        return np.asarray(self.surface.vertices.mean(axis=0), dtype=np.float64)

    @cached_property
    def structure_points(self) -> FloatArray:
        """Vertices of all structures, in order, (k, 3) m."""
        return np.concatenate([np.empty((0, 3)), *(s.mesh.vertices for s in self.structures)])

    @cached_property
    def structure_index(self) -> NDArray[np.uint32]:
        """Which structure each of `structure_points` belongs to, (k,)."""
        sizes = [len(s.mesh.vertices) for s in self.structures]
        return np.repeat(np.arange(len(sizes), dtype=np.uint32), sizes)

    @cached_property
    def query_points(self) -> FloatArray:
        """Where every estimator answers: `structure_points`, then the surface vertices, (k + n, 3) m."""
        return np.concatenate([self.structure_points, self.surface.vertices])

    @cached_property
    def geometry_digest(self) -> str:
        """Hash of surface, query points and tetrahedra: equal for organs that differ in their attached region alone."""
        content = hashlib.sha256()
        for array in (self.surface.faces, self.query_points, *_arrays(self.tetrahedra)):
            content.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return content.hexdigest()

    def with_attached(self, attached: BoolArray) -> "Organ":
        """Return the same organ attached elsewhere, (n,) flags; what was computed of its geometry is kept."""
        other = make_organ(
            self.name,
            self.frame,
            self.surface,
            self.structures,
            attached,
            self.folder,
            self.system,
            self.tetrahedra,
        )
        other = replace(other, landmarks=self.landmarks)
        for name in ("geometry_digest", "query_points", "structure_points", "surface_lookup"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    @cached_property
    def surface_lookup(self) -> SurfaceLookup:
        """Table for finding the nearest surface of many points at once; built when first asked for."""
        return build_surface_lookup(self.surface)


def make_organ(
    name: str,
    frame: str,
    surface: SurfaceMesh,
    structures: tuple[Structure, ...],
    attached: BoolArray,
    folder: Path | None = None,
    system: str | None = None,
    tetrahedra: VolumeMesh | None = None,
) -> Organ:
    """Make an organ and hash its content."""
    content = hashlib.sha256()
    flags = np.ascontiguousarray(attached, dtype=np.bool_)
    for array in (surface.vertices, surface.faces, flags):
        content.update(f"{array.shape}{array.dtype.str}".encode() + array.tobytes())
    for structure in structures:
        content.update(f"{structure.name}\0{structure.kind}\0{structure.colour}".encode())
        for array in (structure.mesh.vertices, structure.mesh.faces):
            content.update(f"{array.shape}".encode() + array.tobytes())
    for array in _arrays(tetrahedra):
        content.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return Organ(name, frame, surface, structures, flags, folder, content.hexdigest(), system, tetrahedra)


def _arrays(mesh: VolumeMesh | None) -> tuple[FloatArray | IntArray, ...]:
    return () if mesh is None else (mesh.nodes, mesh.tets)


def load_organ(folder: Path, roots: tuple[Path, ...] | None = None) -> Organ:
    """Read an organ folder; `docs/reference/organ_files.md` describes `organ.yaml`.

    Parameters
    ----------
    folder : Path
    roots : tuple of Path, optional
        Folders outside of which neither it nor a file that it names may lie; None for anywhere.

    Raises
    ------
    OrganError
        If `organ.yaml` or what it describes cannot be meant: a missing file, a unit that gives no organ's size, a
        structure far from the organ, an attached region without a vertex.
    MeshError
        If a mesh cannot be read.
    """
    folder = Path(folder)
    file = read_organ_file(folder, roots)
    stored = clean_organ_surface(read_mesh(file.surface, file.unit_m), str(file.surface))
    check_size(stored.mesh, file.path, file.unit, file.unit_m)
    check_closed(stored.mesh, str(file.surface))
    warn_of_stray_vertices(stored, str(file.surface))
    system = _surface_system(stored, file)
    meshes = [read_mesh(entry.mesh, file.unit_m, system) for entry in file.structures]
    system = system or _common_system(meshes, file)
    structures = tuple(map(_structure, file.structures, meshes))
    for structure in structures:
        check_place(structure.name, structure.mesh, stored.mesh, file.path)
    attached = _attached_vertices(stored, file, system)
    tetrahedra = None
    if file.tetrahedra is not None:
        tetrahedra = read_tetrahedra(file.tetrahedra, file.unit_m, system, stored.mesh)
    organ = make_organ(file.name, file.frame, stored.mesh, structures, attached, folder, system, tetrahedra)
    return replace(organ, landmarks=check_landmarks(file.landmarks, stored.mesh, file.path))


def _surface_system(surface: StoredMesh, file: OrganFile) -> str | None:
    """Return the coordinate system that the surface or `organ.yaml` states; they must not contradict each other."""
    if surface.system is not None and file.system not in (None, surface.system):
        raise OrganError(
            f"{file.path}, system: expected {surface.system}, as {file.surface.name} states, got {file.system}"
        )
    return surface.system or file.system


def _common_system(structures: Sequence[StoredMesh], file: OrganFile) -> str | None:
    """Return the coordinate system that structures state beside a surface that states none."""
    stated = sorted({mesh.system for mesh in structures if mesh.system is not None})
    if len(stated) > 1:
        raise OrganError(
            f"{file.path}: expected a surface that states its coordinate system, since structures state "
            f"{' and '.join(stated)}, got {file.surface.name}, which states none; state it as system"
        )
    return stated[0] if stated else None


def _structure(entry: StructureEntry, stored: StoredMesh) -> Structure:
    warn_of_stray_vertices(stored, str(entry.mesh))
    return Structure(entry.name, entry.kind, stored.mesh, entry.colour)


def _attached_vertices(stored: StoredMesh, file: OrganFile, system: str | None) -> BoolArray:
    vertices = stored.mesh.vertices
    attached = np.zeros(len(vertices), dtype=np.bool_)
    entry = file.attached
    if entry is None:
        _log.warning("%s says nothing about where the organ is attached; it is taken as free", file.path)
        return attached
    if entry.vertices:
        attached[_listed_vertices(stored, entry.vertices, file)] = True
    for i, (centre, radius) in enumerate(entry.spheres):
        gap = np.linalg.norm(vertices - np.array(centre), axis=1) - radius
        _check_reached(gap, f"{file.path}, attached.spheres[{i}]")
        attached |= gap <= 0.0
    if entry.touching is not None:
        mesh, distance = entry.touching
        touching = read_mesh(mesh, file.unit_m, system).mesh
        squared = igl.point_mesh_squared_distance(vertices, touching.vertices, touching.faces)[0]
        gap = np.sqrt(np.asarray(squared, dtype=np.float64)) - distance
        where = f"{file.path}, attached.touching"
        _check_reached(gap, where, mirror_hint(stored.mesh, touching.vertices, 0.0))
        attached |= gap <= 0.0
    if entry.patch is not None:
        centre, share = entry.patch
        attached |= patch(stored.mesh, np.array(centre), share)
    if not attached.any() or attached.all():
        got = "all of them" if attached.any() else "none"
        raise OrganError(
            f"{file.path}, attached: expected some of the {len(vertices)} surface vertices, got {got}"
        )
    return attached


def _check_reached(gap_m: FloatArray, where: str, hint: str = "") -> None:
    """Raise OrganError unless something of the surface is within reach; (n,) distances beyond it, m."""
    if gap_m.min() > 0.0:
        raise OrganError(
            f"{where}: expected surface vertices within its reach, got none, the nearest "
            f"{1e3 * gap_m.min():.3g} mm beyond it{hint}"
        )


def _listed_vertices(stored: StoredMesh, listed: tuple[int, ...], file: OrganFile) -> IntArray:
    if file.surface.suffix.lower() == ".stl":
        raise OrganError(
            f"{file.path}, attached.vertices: expected a surface whose file numbers its vertices, got an STL; "
            "use spheres, touching, or a surface of another format"
        )
    index = np.array(listed, dtype=np.int64)
    count = len(stored.vertex_of_stored)
    if index.min() < 0 or index.max() >= count:
        raise OrganError(
            f"{file.path}, attached.vertices: expected indices from 0 to {count - 1} (the first vertex of the file "
            f"is 0), got {index.min()} to {index.max()}"
        )
    found = stored.vertex_of_stored[index]
    if (found < 0).any():
        _log.info(
            "%s: %d of the %d attached vertices are not on the surface",
            file.path,
            int((found < 0).sum()),
            len(found),
        )
    return found[found >= 0]
