"""The organ before the operation: surface, vessels, tumour, attached and visible patch; and its folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.surface_patch import patch
from softtissue_estimator.organ.tetrahedra_file import write_tetrahedra
from softtissue_estimator.organ.volume_mesh import edge_length
from softtissue_training.phantom.filled_shape import coarse_tetrahedra
from softtissue_training.phantom.implicit import Implicit, Points
from softtissue_training.phantom.isosurface import isosurface
from softtissue_training.phantom.liver_shape import LiverShape, random_liver
from softtissue_training.phantom.spec import PhantomSpec
from softtissue_training.phantom.tumour import place_tumour
from softtissue_training.phantom.vessels import grow_tree, interior_points

Array = NDArray[np.float64]
ORGAN_FRAME = "organ"
TETRAHEDRA_FILE = "tetrahedra.vtu"

# Where the vessels enter: from a point outside (m) towards one inside, 10 mm below the surface.
_PORTAL_ENTRY = ((0.008, 0.060, -0.030), (-0.005, 0.0, 0.010))
_HEPATIC_ENTRY = ((0.010, 0.060, 0.060), (0.0, 0.010, 0.040))
_ENTRY_DEPTH_M = 0.010
_VESSEL_DEPTH_M = 0.010
_VESSEL_END_RADIUS_M = 0.0018
_VESSEL_GAP_M = 0.007
_VESSEL_CANDIDATES = 700
_TUMOUR_RADIUS_M = 0.014
_TUMOUR_DEPTH_M = 0.026
_TUMOUR_GAP_M = 0.002


@dataclass(frozen=True)
class Part:
    """A structure inside the organ: its name and kind, its surface (m) and its colour (RGB, 0 to 1)."""

    name: str
    kind: str
    mesh: SurfaceMesh
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class Anatomy:
    """The phantom as a scan would show it, in the organ's frame.

    Attributes
    ----------
    shape
        The solid whose zero set is the surface.
    surface
        n vertices, m.
    parts
        Vessels and tumour.
    attached, visible
        (n,) bool, per surface vertex.
    """

    shape: LiverShape
    surface: SurfaceMesh
    parts: tuple[Part, ...]
    attached: NDArray[np.bool_]
    visible: NDArray[np.bool_]

    @property
    def query_points(self) -> Array:
        """Vertices of all parts in order, then of the surface, ``(q, 3)`` m: the order of `Organ.query_points`."""
        return np.concatenate([*(part.mesh.vertices for part in self.parts), self.surface.vertices])


def build_anatomy(
    spec: PhantomSpec, rng: np.random.Generator, progress: Callable[[str], None] = lambda _: None
) -> Anatomy:
    """Make the organ and what lies inside it.

    Raises
    ------
    MeshError
        If a structure does not lie wholly inside the organ.
    """
    progress("organ surface")
    liver = random_liver(rng)
    surface = isosurface(liver, *liver.box, spec.surface_spacing)
    progress("vessels")
    candidates = interior_points(liver, liver.box, _VESSEL_DEPTH_M, _VESSEL_CANDIDATES, rng)
    portal_root = enter_organ(liver, straight_way(*np.array(_PORTAL_ENTRY)))
    portal = grow_tree(liver, portal_root, spec.portal_ends, candidates, _VESSEL_END_RADIUS_M)
    candidates = interior_points(
        liver,
        liver.box,
        _VESSEL_DEPTH_M,
        _VESSEL_CANDIDATES,
        rng,
        free=lambda points: portal(points) > _VESSEL_GAP_M,
    )
    hepatic_root = enter_organ(liver, straight_way(*np.array(_HEPATIC_ENTRY)))
    hepatic = grow_tree(liver, hepatic_root, spec.hepatic_ends, candidates, _VESSEL_END_RADIUS_M)
    portal_mesh = isosurface(portal, *portal.box, spec.vessel_spacing, rounds=8)
    hepatic_mesh = isosurface(hepatic, *hepatic.box, spec.vessel_spacing, rounds=8)
    progress("tumour")
    room = interior_points(
        liver, liver.box, _TUMOUR_DEPTH_M, 2000, rng, free=lambda points: points[:, 0] < -0.02
    )
    tumour = place_tumour(
        room, (portal_mesh.vertices, hepatic_mesh.vertices), _TUMOUR_RADIUS_M, _TUMOUR_GAP_M, rng
    )
    parts = (
        Part("portal vein", "vessel", portal_mesh, (0.25, 0.35, 0.85)),
        Part("hepatic veins", "vessel", hepatic_mesh, (0.35, 0.70, 0.90)),
        Part("tumour", "tumour", isosurface(tumour, *tumour.box, spec.vessel_spacing), (0.95, 0.85, 0.20)),
    )
    check_inside(liver, parts)
    return Anatomy(
        liver,
        surface,
        parts,
        attached=patch(surface, np.array(spec.attached_point), spec.attached_share),
        visible=patch(surface, np.array(spec.visible_point), spec.visible_share),
    )


def straight_way(start: Points, end: Points) -> Points:
    """Points on the way from one point ``(3,)`` to another, ``(1000, 3)``."""
    return start + np.linspace(0.0, 1.0, 1000)[:, None] * (end - start)


def enter_organ(shape: Implicit, way: Points) -> Array:
    """First point ``(3,)`` m of a way ``(k, 3)`` m into an organ that lies 10 mm below its surface.

    Raises
    ------
    MeshError
        If no point of the way does.
    """
    deep = shape(way) < -_ENTRY_DEPTH_M
    if not deep.any():
        raise MeshError(f"expected the organ between {way[0]} and {way[-1]} m, found none")
    return np.array(way[int(np.argmax(deep))])


def check_inside(shape: Implicit, parts: tuple[Part, ...]) -> None:
    """Refuse structures that do not lie wholly inside an organ.

    Raises
    ------
    MeshError
        If one reaches closer than 1 mm to the surface.
    """
    for part in parts:
        outermost = float(shape(part.mesh.vertices).max())
        if outermost > -0.001:
            raise MeshError(
                f"expected the {part.name} at least 1 mm inside the organ, "
                f"got {1e3 * outermost:.1f} mm (negative is inside)"
            )


def write_organ(anatomy: Anatomy, folder: Path, name: str) -> None:
    """Write the organ's folder: PLY files in millimetres, tetrahedra, the attached vertices and `organ.yaml`.

    Raises
    ------
    MeshError
        If the organ cannot be filled with tetrahedra.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _write_ply(anatomy.surface, folder / "liver.ply")
    structures = []
    for part in anatomy.parts:
        file = part.name.replace(" ", "_") + ".ply"
        _write_ply(part.mesh, folder / file)
        structures.append({"name": part.name, "kind": part.kind, "mesh": file, "colour": list(part.colour)})
    tetrahedra = coarse_tetrahedra(anatomy.shape, edge_length(enclosed_volume(anatomy.surface)))
    write_tetrahedra(folder / TETRAHEDRA_FILE, tetrahedra, 0.001, anatomy.surface)
    indices = np.flatnonzero(anatomy.attached)
    (folder / "attached.txt").write_text("".join(f"{index}\n" for index in indices))
    content = {
        "name": name,
        "frame": ORGAN_FRAME,
        "unit": "mm",
        "surface": "liver.ply",
        "tetrahedra": TETRAHEDRA_FILE,
        "structures": structures,
        "attached": {"vertices": "attached.txt"},
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    (folder / "organ.yaml").write_text(text)


def _write_ply(mesh: SurfaceMesh, path: Path) -> None:
    """Write binary PLY in millimetres; vertices keep their order."""
    exported = trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces, process=False)
    with path.open("wb") as stream:
        exported.export(file_obj=stream, file_type="ply", vertex_normal=False)
