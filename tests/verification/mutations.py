"""Mistakes that the verification tests must notice; `scripts/mutate_physics` makes them one at a time."""

from __future__ import annotations

from typing import NamedTuple


class Mutation(NamedTuple):
    """One mistake: in `file`, `right` becomes `wrong`; slow tests run only where they are meant to notice."""

    what: str
    file: str
    right: str
    wrong: str
    slow: bool = False


MUTATIONS = (
    # Small matrices
    Mutation("determinant: sign of one cofactor", "physics/small_matrices.py", "- m[0, 1] *", "+ m[0, 1] *"),
    Mutation("inverse: transposed", "physics/small_matrices.py", "adjugate[i, j] = m", "adjugate[j, i] = m"),
    # Materials
    Mutation(
        "Lame's mu without the factor two",
        "physics/material.py",
        "young / (2.0 * (1.0 + nu))",
        "young / (1.0 + nu)",
    ),
    Mutation("Lame's lambda: 1 - nu for 1 - 2 nu", "physics/material.py", "(1.0 - 2.0 * nu)", "(1.0 - nu)"),
    Mutation(
        "neo-Hookean energy: sign of mu ln J", "physics/material.py", "- mu * _log(det)", "+ mu * _log(det)"
    ),
    Mutation(
        "volumetric energy: factor two", "physics/material.py", "+ 0.5 * lam * strain**2", "+ lam * strain**2"
    ),
    Mutation(
        "energy finite in inverted elements",
        "physics/material.py",
        "np.where(det > 0.0, value, np.inf)",
        "value",
    ),
    Mutation(
        "neo-Hookean stress: sign of the pressure",
        "physics/material.py",
        "(pressure - mu)[",
        "(-pressure - mu)[",
    ),
    Mutation(
        "St Venant-Kirchhoff stress: factor two",
        "physics/material.py",
        "+ 2.0 * mu * strain",
        "+ mu * strain",
        True,
    ),
    Mutation(
        "strain: left for right Cauchy-Green",
        "physics/material.py",
        '"...KI,...KJ->...IJ"',
        '"...IK,...JK->...IJ"',
    ),
    Mutation(
        "tangent: axes of the shear term",
        "physics/material.py",
        '"...iL,...kJ->...iJkL", normal',
        '"...iJ,...kL->...iJkL", normal',
    ),
    Mutation("tangent: sign of lambda", "physics/material.py", "result + lam *", "result - lam *"),
    Mutation(
        "contracted tangent: axes",
        "physics/material.py",
        "blocks += lam * _outer(spatial_first, spatial_second)",
        "blocks += lam * _outer(spatial_second, spatial_first)",
    ),
    Mutation(
        "contracted tangent: factor two",
        "physics/material.py",
        "blocks += mu * along",
        "blocks += 2.0 * mu * along",
    ),
    Mutation(
        "derivative of ln J: transposed",
        "physics/material.py",
        "return np.swapaxes(inverse(deformation_gradient)[0], -1, -2)",
        "return inverse(deformation_gradient)[0]",
    ),
    Mutation(
        "any modulus allowed",
        "physics/material.py",
        "if not self.youngs_modulus_pa > 0.0",
        "if self.youngs_modulus_pa is None",
    ),
    # Elements
    Mutation(
        "volume of an element: factor two",
        "physics/body.py",
        "np.linalg.det(edges) / 6.0",
        "np.linalg.det(edges) / 3.0",
    ),
    Mutation("gradient of the first vertex: sign", "physics/body.py", "[-inner.sum(", "[inner.sum("),
    Mutation(
        "deformation gradient: transposed",
        "physics/body.py",
        ".T)\n        return result.reshape(3, 3, -1)",
        ".T)\n        return result.reshape(3, 3, -1).swapaxes(0, 1)",
    ),
    Mutation(
        "internal force: sign",
        "physics/body.py",
        "np.moveaxis(stress, 0, 2) * self.volume",
        "-np.moveaxis(stress, 0, 2) * self.volume",
    ),
    Mutation("tangent not made definite", "physics/body.py", "np.maximum(values, 0.0)", "values"),
    Mutation(
        "inverted meshes allowed", "physics/body.py", "if volumes.min() <= 0.0", "if volumes.min() <= -1.0"
    ),
    Mutation(
        "blocks: transposed",
        "physics/block_system.py",
        "blocks.transpose(2, 3, 1, 0)",
        "blocks.transpose(3, 2, 1, 0)",
    ),
    Mutation(
        "noise of 1e-15 in the stiffness",
        "physics/block_system.py",
        "np.asarray(self._sum_blocks @ values)",
        "np.asarray(self._sum_blocks @ values) * (1.0 + 1e-15 * np.random.default_rng().normal())",
        True,
    ),
    # Averaged volumetric strain
    Mutation(
        "averaging: a third to each of four",
        "physics/averaged_body.py",
        "np.repeat(self.volume / 4.0, 4)",
        "np.repeat(self.volume / 3.0, 4)",
    ),
    Mutation(
        "averaging: sign of the pressure's block",
        "physics/averaged_body.py",
        "= -share / self._lam",
        "= share / self._lam",
    ),
    Mutation(
        "averaging: coupling of the wrong vertex",
        "physics/averaged_body.py",
        "(share * second)[..., None]",
        "(share * first)[..., None]",
    ),
    Mutation(
        "averaging: energy, factor two",
        "physics/averaged_body.py",
        "shear + 0.5 * self._lam",
        "shear + self._lam",
    ),
    Mutation(
        "averaging: not done (locks)",
        "physics/averaged_body.py",
        "        return self._to_elements(self._lam * self._average(self.material.volumetric_strain(gradient)))",
        "        return self._lam * self.material.volumetric_strain(gradient)",
        True,
    ),
    Mutation(
        "averaging without lambda allowed",
        "physics/averaged_body.py",
        "if self._lam <= 0.0",
        "if self._lam < -1e9",
    ),
    # Newton, reactions, choice of the formulation
    Mutation("reaction: sign", "physics/solver.py", "internal - loaded, 0.0", "loaded - internal, 0.0"),
    Mutation(
        "reaction: twice",
        "physics/solver.py",
        "np.where(fixed, internal - loaded",
        "2.0 * np.where(fixed, internal - loaded",
    ),
    Mutation(
        "load of the wrong axis",
        "physics/solver.py",
        "    load = Load(body, force, pressure)",
        "    load = Load(body, np.roll(force, 1, axis=1), pressure)",
        True,
    ),
    Mutation(
        "prescribed displacement: sign",
        "physics/solver.py",
        "0.0 if prescribed is None else prescribed",
        "0.0 if prescribed is None else -prescribed",
    ),
    Mutation(
        "stops far from equilibrium", "physics/solver.py", "if residual < tolerance:", "if residual < 0.1:"
    ),
    Mutation(
        "averaging for compressible materials",
        "physics/solver.py",
        "poisson_ratio > NEARLY",
        "poisson_ratio < NEARLY",
    ),
    Mutation("loose bodies allowed", "physics/solver.py", "if components < 6", "if components < 1"),
    Mutation(
        "diverged solves pass for solved",
        "physics/load_stepping.py",
        "                raise SolverDivergedError(\n",
        "                return displacement, 0, 1\n                raise SolverDivergedError(\n",
    ),
    # Load stepping
    Mutation(
        "load always in two increments",
        "physics/load_stepping.py",
        "start, 0.0, 1.0, 0, 0",
        "start, 0.0, 0.5, 0, 0",
    ),
    Mutation("increments do not grow", "physics/load_stepping.py", "increment *= 2.0", "increment *= 1.0"),
    Mutation(
        "increments start from rest",
        "physics/load_stepping.py",
        "advance(displacement, reached + increment)",
        "advance(start, reached + increment)",
    ),
    Mutation(
        "no increments",
        "physics/load_stepping.py",
        "if increment <= SMALLEST_INCREMENT",
        "if increment <= 1.0",
    ),
    # Pressure
    Mutation(
        "pressure: sign",
        "physics/pressure.py",
        "-self.pressure_pa[:, None] / 6.0",
        "self.pressure_pa[:, None] / 6.0",
    ),
    Mutation(
        "pressure: factor two",
        "physics/pressure.py",
        "self.pressure_pa[:, None] / 6.0",
        "self.pressure_pa[:, None] / 3.0",
    ),
    Mutation(
        "pressure: on the body at rest",
        "physics/load.py",
        "self.pressure.force(self.body.vertices + displacement)",
        "self.pressure.force(self.body.vertices)",
    ),
    Mutation(
        "pressure: cone instead of triangle",
        "physics/pressure.py",
        "np.cross(b - a, c - a)",
        "np.cross(b, c)",
    ),
    Mutation(
        "pressure's stiffness: sign", "physics/pressure.py", "s = -self.pressure_pa", "s = self.pressure_pa"
    ),
    Mutation(
        "pressure inside the body allowed",
        "physics/pressure.py",
        "[owner[tuple(face)] for",
        "[owner.get(tuple(face), 0) for",
    ),
    Mutation(
        "pressures of any shape allowed",
        "physics/pressure.py",
        "if self.faces.shape != (count, 3) or self.pressure_pa.shape != (count,):",
        "if count < 0:",
    ),
    # The comparison with CalculiX
    Mutation(
        "CalculiX: another law taken for ours",
        "comparison/calculix.py",
        "elif material.poisson_ratio == 0.0:",
        "elif True:",
    ),
    Mutation(
        "CalculiX: pressure on another face",
        "comparison/calculix.py",
        "((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3))",
        "((0, 1, 3), (0, 1, 2), (1, 2, 3), (0, 2, 3))",
    ),
)
