"""The whole way from a seed to a case folder, of the form that users write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume, vertex_areas
from softtissue_training.experiments.breathing_liver.breath import CAVA_REACH_M, Breath, simulate
from softtissue_training.experiments.breathing_liver.liver import Anatomy, build_anatomy
from softtissue_training.experiments.breathing_liver.scan import segment
from softtissue_training.experiments.breathing_liver.spec import BreathingSpec
from softtissue_training.phantom.anatomy import ORGAN_FRAME, Part
from softtissue_training.phantom.vessels import interior_points

FloatArray = NDArray[np.float64]

NAME = "Breathing liver"
_MM_PER_M = 1e3
_INNER_DEPTH_M = 0.004
_STRUCTURE_STRIDE = 3  # of a structure's vertices, one in so many has its true displacement written


@dataclass(frozen=True)
class BreathingLiver:
    """What was made, for reports and tests."""

    anatomy: Anatomy
    breath: Breath
    truth: dict[str, FloatArray]  # displacement (n, 3) m from the exhaled to the inhaled state, by part


def build_case(
    spec: BreathingSpec, folder: Path, progress: Callable[[str], None] = lambda _: None
) -> BreathingLiver:
    """Make a breathing liver and write its case folder.

    Each step has a random generator of its own, all from `spec.seed`, so that a change in one leaves the others'
    choices alone.
    """
    shape_rng, point_rng, first_rng, second_rng = np.random.default_rng(spec.seed).spawn(4)
    anatomy = build_anatomy(spec, shape_rng, progress)
    breath = simulate(anatomy, spec, progress)
    pose = _pose(spec)
    folder.mkdir(parents=True, exist_ok=True)
    progress("segmenting the exhaled liver")
    _write_scan(folder, _scan(anatomy, lambda p: breath.states(p)[0], spec, first_rng), "exhaled")
    progress("segmenting the inhaled liver")
    _write_scan(
        folder, _scan(anatomy, lambda p: pose.apply(breath.states(p)[1]), spec, second_rng), "inhaled"
    )
    _write_ply(anatomy.cava, folder / "vena_cava.ply")
    _write_yaml(folder / "organ.yaml", _organ_file(anatomy.parts))
    _write_yaml(folder / "case.yaml", _case_file(anatomy.parts))
    truth = _write_truth(folder / "truth.npz", anatomy, breath, pose, spec, point_rng)
    return BreathingLiver(anatomy, breath, truth)


def describe(made: BreathingLiver, spec: BreathingSpec) -> str:
    """Report a breathing liver's measures, a line each, in millimetres, millilitres and per cent."""
    surface = made.anatomy.surface
    size = _MM_PER_M * np.ptp(surface.vertices, axis=0)
    lines = [
        f"organ: {1e6 * enclosed_volume(surface):.0f} ml, {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, "
        f"{1e4 * vertex_areas(surface).sum():.0f} cm^2",
        *(f"{p.name}: {1e6 * enclosed_volume(p.mesh):.1f} ml" for p in made.anatomy.parts),
        f"finite elements: {made.breath.nodes} nodes, {len(made.breath.equilibria)} equilibria, largest relative "
        f"residual {max(state.residual for state in made.breath.equilibria):.1e}",
    ]
    for part, displacement in made.truth.items():
        moved = _MM_PER_M * np.linalg.norm(displacement, axis=1)
        lines.append(
            f"{part}: {len(moved)} points move {moved.mean():.1f} mm on average, {moved.max():.1f} at most"
        )
    return "\n".join(lines)


def _pose(spec: BreathingSpec) -> RigidMotion:
    rotation = Rotation.from_rotvec(np.radians(spec.pose_degrees)).as_matrix()
    return RigidMotion(rotation, np.array(spec.pose_m))


def _scan(
    anatomy: Anatomy, place: Callable[[FloatArray], FloatArray], spec: BreathingSpec, rng: np.random.Generator
) -> dict[str, SurfaceMesh]:
    """Segment the organ and its parts where `place` takes points of the body at rest."""

    def scanned(mesh: SurfaceMesh, spacing: float, error: float) -> SurfaceMesh:
        moved = SurfaceMesh(place(mesh.vertices), mesh.faces)
        return segment(moved, spacing, error, spec.error_length, rng)

    found = {"liver": scanned(anatomy.surface, spec.organ_spacing, spec.organ_error)}
    for part in anatomy.parts:
        found[part.name] = scanned(part.mesh, spec.vessel_spacing, spec.vessel_error)
    return found


def _write_scan(folder: Path, meshes: dict[str, SurfaceMesh], state: str) -> None:
    for name, mesh in meshes.items():
        _write_ply(mesh, folder / _file(name, state))


def _file(name: str, state: str) -> str:
    return f"{name.replace(' ', '_')}_{state}.ply"


def _organ_file(parts: tuple[Part, ...]) -> dict[str, object]:
    return {
        "name": NAME,
        "frame": ORGAN_FRAME,
        "unit": "mm",
        "surface": _file("liver", "exhaled"),
        "structures": [
            {"name": p.name, "kind": p.kind, "mesh": _file(p.name, "exhaled"), "colour": list(p.colour)}
            for p in parts
        ],
        "attached": {"touching": {"mesh": "vena_cava.ply", "distance": _MM_PER_M * CAVA_REACH_M}},
    }


def _case_file(parts: tuple[Part, ...]) -> dict[str, object]:
    return {
        "unit": "mm",
        "system": "LPS",
        "surface_after": _file("liver", "inhaled"),
        "structures_after": [{"name": p.name, "mesh": _file(p.name, "inhaled")} for p in parts],
        "truth": "truth.npz",
    }


def _write_yaml(path: Path, content: dict[str, object]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def _write_truth(
    path: Path,
    anatomy: Anatomy,
    breath: Breath,
    pose: RigidMotion,
    spec: BreathingSpec,
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Write where points were and are, mm in the two scans' frames; return displacements without the pose, m."""
    groups = {
        "inside": interior_points(anatomy.shape, anatomy.shape.box, _INNER_DEPTH_M, spec.inner_points, rng),
        "surface": anatomy.surface.vertices,
        **{part.name: part.mesh.vertices[::_STRUCTURE_STRIDE] for part in anatomy.parts},
    }
    states = {part: breath.states(points) for part, points in groups.items()}
    np.savez_compressed(
        path,
        before=np.concatenate([_MM_PER_M * before for before, _ in states.values()]).astype(np.float32),
        after=np.concatenate([_MM_PER_M * pose.apply(after) for _, after in states.values()]).astype(
            np.float32
        ),
        part=np.concatenate([np.full(len(points), part) for part, points in groups.items()]),
    )
    return {part: after - before for part, (before, after) in states.items()}


def _write_ply(mesh: SurfaceMesh, path: Path) -> None:
    """Write binary PLY in millimetres, single precision."""
    exported = trimesh.Trimesh(_MM_PER_M * mesh.vertices, mesh.faces, process=False)
    with path.open("wb") as stream:
        exported.export(file_obj=stream, file_type="ply", vertex_normal=False)


def coarse(spec: BreathingSpec) -> BreathingSpec:
    """Return the same liver with everything coarse: a case in seconds, for tests."""
    return replace(
        spec,
        organ_spacing=0.011,
        vessel_spacing=0.003,
        element_size=0.024,
        portal_ends=5,
        hepatic_ends=4,
        inner_points=100,
    )
