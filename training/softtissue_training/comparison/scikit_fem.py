"""scikit-fem (BSD-3): assembly of forms in NumPy; the laws and Newton's method are written out here."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.load_stepping import apply_load
from softtissue_training.physics.material import Material

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MAX_ITERATIONS = 30


def solve_with_scikit_fem(
    vertices: FloatArray, tets: IntArray, fixed: BoolArray, force: FloatArray, material: Material
) -> FloatArray:
    """Return the equilibrium displacement, (n, 3) metres, under dead forces; arguments as in `solver.solve`.

    Raises
    ------
    SolverDivergedError
        Not even the smallest increment converges.
    """
    import skfem

    basis: Any = skfem.Basis(
        skfem.MeshTet(vertices.T.copy(), tets.T.copy()), skfem.ElementVector(skfem.ElementTetP1())
    )
    by_component = np.repeat(fixed[:, None], 3, axis=1) if fixed.ndim == 1 else fixed
    order = basis.nodal_dofs.T  # (n, 3)
    held = order[by_component]
    free = np.setdiff1d(np.arange(basis.N), held)
    external = np.zeros(basis.N)
    external[order] = force
    residual_form, tangent_form = _forms(material)

    def advance(last: FloatArray, share: float) -> tuple[FloatArray, int]:
        values = np.zeros(basis.N)
        values[order] = last
        for iteration in range(_MAX_ITERATIONS):
            field = basis.interpolate(values)
            with np.errstate(all="ignore"):
                unbalanced = share * external - residual_form.assemble(basis, u=field)
            size = np.linalg.norm(unbalanced[free])
            if not np.isfinite(size):
                break
            if size < 1e-6 * max(share * float(np.linalg.norm(force)), 1e-12):
                return values[order], iteration
            tangent = tangent_form.assemble(basis, u=field)
            values = values + skfem.solve(*skfem.condense(tangent, unbalanced, D=held))
        raise SolverDivergedError(f"scikit-fem: no equilibrium in {_MAX_ITERATIONS} steps")

    return apply_load(advance, np.zeros_like(vertices))[0]


def _forms(material: Material) -> tuple[Any, Any]:
    """Return the weak form of equilibrium and its derivative."""
    import skfem
    from skfem.helpers import ddot, det, eye, grad, inv, mul, trace, transpose

    lam, mu = material.lame_pa

    def deformation(w: Any) -> Any:
        return grad(w["u"]) + eye(np.ones_like(w["u"].grad[0, 0]), 3)

    def force(v: Any, w: Any) -> Any:
        f = deformation(w)
        if material.law == "neo_hookean":
            normal = transpose(inv(f))
            return ddot(mu * (f - normal) + lam * np.log(det(f)) * normal, grad(v))
        strain = 0.5 * (mul(transpose(f), f) - eye(np.ones_like(f[0, 0]), 3))
        return ddot(mul(f, lam * eye(trace(strain), 3) + 2 * mu * strain), grad(v))

    def stiffness(du: Any, v: Any, w: Any) -> Any:
        f, change = deformation(w), grad(du)
        if material.law == "neo_hookean":
            normal = transpose(inv(f))
            turned = mul(mul(normal, transpose(change)), normal)  # minus the change of the normal
            pressure = lam * np.log(det(f)) - mu
            return ddot(mu * change - pressure * turned + lam * ddot(normal, change) * normal, grad(v))
        strain = 0.5 * (mul(transpose(f), f) - eye(np.ones_like(f[0, 0]), 3))
        gain = 0.5 * (mul(transpose(change), f) + mul(transpose(f), change))
        stress = lam * eye(trace(strain), 3) + 2 * mu * strain
        return ddot(mul(change, stress) + mul(f, lam * eye(trace(gain), 3) + 2 * mu * gain), grad(v))

    return skfem.LinearForm(force), skfem.BilinearForm(stiffness)
