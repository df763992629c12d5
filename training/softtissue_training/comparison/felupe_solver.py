"""FElupe (GPL-3): hyperelasticity in NumPy; here with PARDISO where pypardiso is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.load_stepping import apply_load
from softtissue_training.physics.material import Material

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def solve_with_felupe(
    vertices: FloatArray, tets: IntArray, fixed: BoolArray, force: FloatArray, material: Material
) -> FloatArray:
    """Return the equilibrium displacement, (n, 3) metres, under dead forces; arguments as in `solver.solve`.

    FElupe's Newton method has no line search; what does not converge at once is applied in our increments.

    Raises
    ------
    SolverDivergedError
        Not even the smallest increment converges.
    """
    import felupe

    linear_solver: Any = spsolve
    if find_spec("pypardiso") is not None:
        import pypardiso

        linear_solver = pypardiso.spsolve
    mesh = felupe.Mesh(vertices, tets, "tetra")
    values = felupe.Field(felupe.RegionTetra(mesh), dim=3)
    field = felupe.FieldContainer([values])
    body = felupe.SolidBody(_law(material), field)
    by_component = np.repeat(fixed[:, None], 3, axis=1) if fixed.ndim == 1 else fixed
    held = np.flatnonzero(by_component.ravel())
    free = np.flatnonzero(~by_component.ravel())

    def advance(last: FloatArray, share: float) -> tuple[FloatArray, int]:
        values.values[:] = last
        load = felupe.PointLoad(field, np.arange(len(vertices)), values=share * force)
        try:
            with np.errstate(all="ignore"):
                answer: Any = felupe.newtonrhapson(
                    items=[body, load],
                    dof0=held,
                    dof1=free,
                    ext0=np.zeros(len(held)),
                    solver=linear_solver,
                    tol=1e-6,
                    maxiter=30,
                    verbose=0,
                )
        except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
            raise SolverDivergedError(f"FElupe: {error}") from error
        return answer.x[0].values.copy(), int(answer.iterations)

    return apply_load(advance, np.zeros_like(vertices))[0]


def _law(material: Material) -> Any:
    """Return the law in FElupe; arrays are (3, 3, quadrature points, elements)."""
    import felupe

    lam, mu = material.lame_pa
    if material.law == "neo_hookean":
        return felupe.NeoHookeCompressible(mu=mu, lmbda=lam)
    one = np.eye(3)

    def second_stress(f: FloatArray) -> FloatArray:
        strain = 0.5 * (np.einsum("kI...,kJ...->IJ...", f, f) - one[:, :, None, None])
        result: FloatArray = lam * np.einsum("KK...->...", strain) * one[:, :, None, None] + 2.0 * mu * strain
        return result

    def stress(x: list[Any], **_: Any) -> list[Any]:
        return [np.einsum("iK...,KJ...->iJ...", x[0], second_stress(x[0])), x[-1]]

    def elasticity(x: list[Any], **_: Any) -> list[Any]:
        f = x[0]
        return [
            np.einsum("ik,JL...->iJkL...", one, second_stress(f))
            + lam * np.einsum("iJ...,kL...->iJkL...", f, f)
            + mu * np.einsum("iL...,kJ...->iJkL...", f, f)
            + mu * np.einsum("iM...,kM...,JL->iJkL...", f, f, one)
        ]

    return felupe.Material(stress=stress, elasticity=elasticity)
