"""An organ that moves for some seconds: loads with courses of their own, equilibria at key times, a spline between."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from softtissue_training.errors import RejectedSampleError, SolverDivergedError
from softtissue_training.organs.tetrahedralise import TetMesh
from softtissue_training.physics.load_path import follow
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import make_body
from softtissue_training.simulation.boundary_conditions import (
    STANDARD_GRAVITY_M_S2,
    loaded_patch,
    random_attachment,
    random_direction,
    random_force,
    weight,
)
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.simulate import check_displacement, random_mesh, versions

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PEAK_M = (0.010, 0.040)
"""Range of the largest displacement that loads are scaled for."""
_PEAK_TOLERANCE = 0.25  # share by which the largest displacement may miss what was drawn
_MOST_SCALINGS = 3
_DRAWS_PER_ORGAN = 20
_FIRST_ONSET_S, _LATER_ONSET_S = (0.0, 0.5), (1.0, 5.0)
_CHANGE_S, _HOLD_S = (1.2, 3.0), (0.3, 2.0)
_LOADED, _RELEASED = (0.6, 1.0), (0.0, 0.4)  # shares of the load


@dataclass(frozen=True)
class MotionSettings:
    """What moving organs are made with.

    Attributes
    ----------
    recipe
        Of the organ, its material and its loads: up to three pushed patches, gravity and a pressure.
    duration_s
        Length of the motion.
    states
        Equilibria at even distances in time, the organ at rest included.
    """

    recipe: Recipe = field(
        default_factory=lambda: Recipe(
            shapes="mixed", forces=(1, 3), force_n=(0.3, 1.0), gravity=(0.0, 0.15), pressure_pa=(0.0, 300.0)
        )
    )
    duration_s: float = 10.0
    states: int = 25


@dataclass(frozen=True)
class Course:
    """Course of a load in time: smooth changes from one level to the next, from zero at rest.

    Attributes
    ----------
    changes
        Of each change its start, s, its duration, s, and the share of the load that it leads to.
    """

    changes: tuple[tuple[float, float, float], ...]

    def at(self, times: FloatArray) -> FloatArray:
        """Share of the load at times (s,) s, (s,)."""
        level, result = 0.0, np.zeros_like(times)
        for start, duration, target in self.changes:
            result += (target - level) * _smooth_step((times - start) / duration)
            level = target
        return result


def random_course(rng: np.random.Generator, onset_s: tuple[float, float], duration_s: float) -> Course:
    """Draw when a load rises, how long it holds, how far it is released, and so on."""
    start, level = rng.uniform(*onset_s), 0.0
    changes: list[tuple[float, float, float]] = []
    while start < duration_s:
        change = rng.uniform(*_CHANGE_S)
        level = float(rng.uniform(*(_LOADED if level < 0.5 else _RELEASED)))
        changes.append((float(start), float(change), level))
        start += change + rng.uniform(*_HOLD_S)
    return Course(tuple(changes))


def _smooth_step(x: FloatArray) -> FloatArray:
    """Rise from 0 to 1 between x = 0 and x = 1 with two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    result: FloatArray = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    return result


@dataclass(frozen=True, eq=False)
class MovingOrgan:
    """An organ and its motion; everything in metres and the organ's frame.

    Attributes
    ----------
    mesh
        At rest; the surface's vertices come first.
    attached
        (v,) true for the surface vertices that do not move.
    times
        (s,) s, of the equilibria; the first is the organ at rest.
    displacement
        (s, n, 3) of the nodes.
    about
        Seed, settings, loads and versions as JSON values.
    """

    mesh: TetMesh
    attached: BoolArray
    times: FloatArray
    displacement: FloatArray
    about: dict[str, Any]

    def at(self, times: FloatArray) -> FloatArray:
        """Nodal displacement (t, n, 3) m at times (t,) s: a cubic spline through the equilibria."""
        return np.asarray(self._spline(times))

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.displacement, bc_type=("clamped", "not-a-knot"))


def simulate_motion(seed: int, number: int, settings: MotionSettings) -> MovingOrgan:
    """Draw organs and loads until one moves as it should.

    Parameters
    ----------
    seed, number
        Of the data set, and of the organ in it; the same pair gives the same motion.
    """
    organs, loads = (np.random.default_rng([seed, number, part]) for part in range(2))
    rejected: Counter[str] = Counter()
    while True:
        try:
            mesh = random_mesh(organs, settings.recipe)
            return _random_motion(mesh, loads, settings, (seed, number), rejected)
        except RejectedSampleError as error:
            rejected[error.reason] += 1


def _random_motion(
    mesh: TetMesh,
    rng: np.random.Generator,
    settings: MotionSettings,
    seed: tuple[int, int],
    rejected: Counter[str],
) -> MovingOrgan:
    times = np.linspace(0.0, settings.duration_s, settings.states)
    for _ in range(_DRAWS_PER_ORGAN):
        try:
            material = settings.recipe.draw_material(rng)
            attached = random_attachment(mesh.surface, rng)
            loads = _random_loads(mesh, attached, settings, rng)
            peak = rng.uniform(*PEAK_M)
            scale, displacement = _scaled_motion(mesh, attached, loads, material, times, peak)
        except RejectedSampleError as error:
            rejected[error.reason] += 1
            continue
        about = {
            "seed": list(seed),
            "recipe": settings.recipe.to_json(),
            "duration_s": settings.duration_s,
            "states": settings.states,
            "material": asdict(material),
            "courses": [[list(change) for change in course.changes] for course in loads.courses],
            "scale": scale,
            "rejected": dict(rejected),
            "versions": versions(),
        }
        return MovingOrgan(mesh, attached, times, displacement, about)
    raise RejectedSampleError("no usable load", f"{_DRAWS_PER_ORGAN} loads were rejected")


@dataclass(frozen=True)
class _Loads:
    """Dead loads (l, n, 3) N, then a pressure (f,) Pa on the surface's triangles; a course for each of them."""

    dead: FloatArray
    pressure: FloatArray
    courses: tuple[Course, ...]


def _random_loads(
    mesh: TetMesh, attached: BoolArray, settings: MotionSettings, rng: np.random.Generator
) -> _Loads:
    recipe, surface = settings.recipe, mesh.surface
    dead: list[FloatArray] = []
    for _ in range(rng.integers(*recipe.forces, endpoint=True)):
        force = np.zeros_like(mesh.vertices)
        force[: len(surface.vertices)] = random_force(surface, attached, recipe.force_n, rng)
        dead.append(force)
    gravity = STANDARD_GRAVITY_M_S2 * rng.uniform(*recipe.gravity) * random_direction(rng)
    dead.append(weight(mesh, gravity))
    pressed = loaded_patch(surface, attached, rng)[surface.faces].all(axis=1)
    pressure = np.where(pressed, rng.uniform(*recipe.pressure_pa), 0.0)
    onsets = [_FIRST_ONSET_S] + [_LATER_ONSET_S] * len(dead)
    courses = tuple(random_course(rng, onset, settings.duration_s) for onset in onsets)
    return _Loads(np.stack(dead), pressure, courses)


def _scaled_motion(
    mesh: TetMesh, attached: BoolArray, loads: _Loads, material: Material, times: FloatArray, peak_m: float
) -> tuple[float, FloatArray]:
    """Scale all loads until the organ's largest displacement is about `peak_m`; the factor, and (s, n, 3) m."""
    fixed = np.zeros(len(mesh.vertices), dtype=bool)
    fixed[: len(attached)] = attached
    levels = np.stack([course.at(times) for course in loads.courses], axis=1)
    scale = peak_m / _linear_peak(mesh, fixed, loads, levels, material)
    for _ in range(_MOST_SCALINGS):
        forces = scale * np.einsum("sl,lnc->snc", levels[1:, :-1], loads.dead)
        pressures = tuple(
            SurfacePressure(mesh.faces, scale * level * loads.pressure) for level in levels[1:, -1]
        )
        try:
            moved = follow(mesh.vertices, mesh.tets, fixed, forces, material, pressures)
        except SolverDivergedError as error:
            raise RejectedSampleError("not converged", str(error)) from error
        for state in moved:
            check_displacement(mesh, state)
        found = _largest(moved)
        if abs(found / peak_m - 1.0) <= _PEAK_TOLERANCE:
            return scale, np.concatenate([np.zeros_like(moved[:1]), moved])
        scale *= peak_m / found
    raise RejectedSampleError("moved too far or little", f"expected {peak_m:.3f} m, got {found:.3f} m")


def _linear_peak(
    mesh: TetMesh, fixed: BoolArray, loads: _Loads, levels: FloatArray, material: Material
) -> float:
    """Largest displacement over time, m, if the organ were linear."""
    rest = np.zeros_like(mesh.vertices)
    body = make_body(mesh.vertices, mesh.tets, np.repeat(fixed[:, None], 3, axis=1), material)
    pushed = [*loads.dead, SurfacePressure(mesh.faces, loads.pressure).force(mesh.vertices)]
    answers = np.stack([body.solve_tangent(rest, force, projected=False) for force in pushed])
    return _largest(np.einsum("sl,lnc->snc", levels, answers))


def _largest(displacement: FloatArray) -> float:
    return float(np.linalg.norm(displacement, axis=-1).max())
