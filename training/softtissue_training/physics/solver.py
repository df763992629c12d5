"""Static equilibrium of a hyperelastic body of four-node tetrahedra: total Lagrangian, Newton with line search.

The equilibrium under dead nodal forces f minimises Pi(u) = sum_e V_e W(F_e) - f . u over the free degrees of freedom,
with F_e = I + sum_a u_a (x) grad N_a constant in each element. Newton's step is taken with the exact tangent; where
that step does not lead downhill (the tangent is indefinite), the material tangents are projected onto positive
semi-definite ones (Teran et al. 2005). The line search accepts only lower energy and no inverted element, so that what
is found is a stable equilibrium. Most loads need no increments; those that do get them (`load_stepping`).

Pressure that follows the surface (`pressure`) has no energy; in the line search the work of the mean of the loads
before and after a step stands for it.

Plain tetrahedra lock as Poisson's ratio goes to 0.5, so above `NEARLY_INCOMPRESSIBLE` the volumetric strain is averaged
at the vertices (`averaged_body`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import MovedTooFarError, SolverDivergedError
from softtissue_training.physics.averaged_body import AveragedBody
from softtissue_training.physics.body import Body
from softtissue_training.physics.load import Load
from softtissue_training.physics.load_stepping import apply_load
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

Formulation = Literal["plain", "averaged"]
NEARLY_INCOMPRESSIBLE = 0.40
"""Poisson's ratio above which the volumetric strain is averaged unless a formulation is asked for."""

_ARMIJO_SHARE = 1e-4
_MOST_HALVINGS = 12


@dataclass(frozen=True)
class Solution:
    """Equilibrium of a body.

    Attributes
    ----------
    displacement
        (n, 3) metres.
    reaction
        (n, 3) newtons, the force of the support on each fixed vertex; zero elsewhere up to the residual.
    iterations
        Newton steps taken, over all increments.
    residual
        Norm of the unbalanced force over the norm of the load.
    load
        (n, 3) newtons, dead forces and pressure on the deformed body.
    increments
        Parts in which the load was applied; 1 where the whole load converged at once.
    """

    displacement: FloatArray
    reaction: FloatArray
    iterations: int
    residual: float
    load: FloatArray
    increments: int = 1


def solve(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    force: FloatArray,
    material: Material,
    *,
    prescribed: FloatArray | None = None,
    pressure: SurfacePressure | None = None,
    formulation: Formulation | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 60,
    give_up_beyond_m: float = math.inf,
) -> Solution:
    """Find the equilibrium displacement of a body under dead nodal forces and pressure.

    Parameters
    ----------
    vertices
        (n, 3) metres, reference position.
    tets
        (t, 4) positively oriented elements.
    fixed
        (n,) true where the displacement is prescribed in all three components, or (n, 3) by component.
    force
        (n, 3) newtons.
    prescribed
        (n, 3) metres, used where `fixed`; zero if None.
    pressure
        Pressure that follows the surface, beside `force`.
    formulation
        "plain" tetrahedra, "averaged" volumetric strain, or None to choose by Poisson's ratio.
    tolerance
        Residual relative to the largest of load and internal forces at which the solve has converged.
    max_iterations
        Newton steps for each increment of the load.
    give_up_beyond_m
        Distance that no vertex may go on the way to equilibrium, metres. Under dead loads Newton's steps come near the
        largest displacement from below, so that what goes further is not worth to be solved to the end.

    Raises
    ------
    InvalidInputError
        Shapes do not match or nothing is fixed.
    SolverDivergedError
        No equilibrium, not even in the smallest increments of the load.
    MovedTooFarError
        A vertex went further than `give_up_beyond_m`.
    """
    check_body(vertices, tets, fixed, force)
    if fixed.ndim == 1:
        fixed = np.repeat(fixed[:, None], 3, axis=1)
    body = make_body(vertices, tets, fixed, material, formulation)
    load = Load(body, force, pressure)
    moved = np.where(fixed, 0.0 if prescribed is None else prescribed, 0.0)

    def advance(last: FloatArray, share: float) -> tuple[FloatArray, int]:
        start = _follow_prescribed(body, last, share * moved)
        return find_equilibrium(
            body, start, load.times(share), tolerance, max_iterations, give_up_beyond_m=give_up_beyond_m
        )

    displacement, iterations, increments = apply_load(advance, np.zeros_like(vertices, dtype=np.float64))
    internal, loaded = body.internal_force(displacement), load.force(displacement)
    reaction = np.where(fixed, internal - loaded, 0.0)
    return Solution(displacement, reaction, iterations, _residual(body, loaded, internal), loaded, increments)


def make_body(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    material: Material,
    formulation: Formulation | None = None,
) -> Body:
    """Return the body of a formulation, by default of the one that suits Poisson's ratio.

    `fixed` is (n, 3); the rest is as in `solve`.
    """
    if formulation is None:
        formulation = "averaged" if material.poisson_ratio > NEARLY_INCOMPRESSIBLE else "plain"
    kind = {"plain": Body, "averaged": AveragedBody}[formulation]
    return kind(vertices, tets, fixed, material)


def find_equilibrium(
    body: Body,
    start: FloatArray,
    load: Load,
    tolerance: float,
    max_iterations: int,
    *,
    give_up_beyond_m: float = math.inf,
) -> tuple[FloatArray, int]:
    """Return the equilibrium displacement, (n, 3), reached by Newton's steps from a start, and their number.

    Raises
    ------
    SolverDivergedError
        No equilibrium within `max_iterations`, or no step lowers the energy.
    MovedTooFarError
        A vertex went further than `give_up_beyond_m`.
    """
    displacement = start
    for iteration in range(max_iterations + 1):
        internal, force = body.internal_force(displacement), load.force(displacement)
        residual = _residual(body, force, internal)
        if residual < tolerance:
            return displacement, iteration
        if iteration < max_iterations:
            displacement = _newton_step(body, displacement, load, force - internal)
            _check_distance(displacement, give_up_beyond_m)
    raise SolverDivergedError(
        f"equilibrium needs a relative residual below {tolerance:g} within {max_iterations} iterations, "
        f"got {residual:.3g}"
    )


def _check_distance(displacement: FloatArray, allowed_m: float) -> None:
    if math.isinf(allowed_m):
        return
    largest = float(np.linalg.norm(displacement, axis=1).max())
    if largest > allowed_m:
        raise MovedTooFarError(
            f"displacements must stay below {allowed_m:.3f} m on the way to equilibrium, got {largest:.3f} m"
        )


def _residual(body: Body, force: FloatArray, internal: FloatArray) -> float:
    return _norm((force - internal)[body.free]) / max(_norm(force), _norm(internal), 1e-12)


def _follow_prescribed(body: Body, displacement: FloatArray, prescribed: FloatArray) -> FloatArray:
    """Add the linear answer to what the prescribed displacement gains on the present one."""
    gain = np.where(body.fixed, prescribed - displacement, 0.0)
    if not np.any(gain):
        return displacement
    answer = body.solve_tangent(displacement, -body.stiffness_times(displacement, gain), projected=False)
    start: FloatArray = displacement + gain + answer
    if not np.isfinite(body.energy(start)):
        raise SolverDivergedError(
            "the prescribed displacement inverts elements; prescribe it in smaller steps"
        )
    return start


def _newton_step(body: Body, displacement: FloatArray, load: Load, unbalanced: FloatArray) -> FloatArray:
    energy = body.energy(displacement)
    for projected in (False, True):
        load_stiffness = None if projected else load.stiffness(displacement)
        step = body.solve_tangent(
            displacement, unbalanced, projected=projected, load_stiffness=load_stiffness
        )
        slope = -_dot(unbalanced[body.free], step[body.free])
        if not np.isfinite(slope) or slope >= 0.0:
            continue
        length = 1.0
        for _ in range(_MOST_HALVINGS):
            trial = displacement + length * step
            force = load.mean_force(displacement, trial)
            before = energy - _dot(force, displacement)
            after = body.energy(trial) - _dot(force, trial)
            # Near the solution the gain drowns in rounding.
            if after <= before + _ARMIJO_SHARE * length * slope + 1e-13 * abs(before):
                return trial
            length *= 0.5
    raise SolverDivergedError(
        f"no step of at least {0.5**_MOST_HALVINGS:.1e} times Newton's lowers the energy; unbalanced force "
        f"{_norm(unbalanced[body.free]):.3g} N"
    )


def _dot(a: FloatArray, b: FloatArray) -> float:
    # Not BLAS, whose sum may depend on the number of threads.
    return float(np.sum(a * b))


def _norm(a: FloatArray) -> float:
    return float(np.sqrt(_dot(a, a)))


def check_body(vertices: FloatArray, tets: IntArray, fixed: BoolArray, force: FloatArray) -> None:
    """Check the shapes of what `solve` is given, and that enough is fixed.

    Raises
    ------
    InvalidInputError
        They do not match, or nothing is fixed.
    """
    count = len(vertices)
    if vertices.shape != (count, 3) or force.shape != (count, 3) or fixed.shape not in ((count,), (count, 3)):
        raise InvalidInputError(
            "vertices and force must be (n, 3) and fixed (n,) or (n, 3), "
            f"got {vertices.shape}, {force.shape} and {fixed.shape}"
        )
    if tets.ndim != 2 or tets.shape[1] != 4 or tets.min() < 0 or tets.max() >= count:
        raise InvalidInputError(f"tets must be (t, 4) indices below {count}, got the shape {tets.shape}")
    components = int(fixed.sum()) * (3 if fixed.ndim == 1 else 1)
    if components < 6:
        raise InvalidInputError(f"at least 6 components must be fixed to hold a body, got {components}")
