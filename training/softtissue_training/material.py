"""Energy, stress and tangent of homogeneous isotropic hyperelastic materials, as functions of the deformation gradient.

With C = F^T F, J = det F, E = (C - I) / 2 and the Lame constants lambda, mu:

- neo-Hookean: W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2
- St Venant-Kirchhoff: W = lambda/2 (tr E)^2 + mu tr(E^2), the large-strain law of the paper's solver

P = dW/dF is the first Piola-Kirchhoff stress and A = dP/dF its tangent, A[i, J, k, L] = dP[i, J] / dF[k, L].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.small_matrices import determinant, inverse

FloatArray = NDArray[np.float64]
Law = Literal["neo_hookean", "st_venant_kirchhoff"]
LAWS: tuple[Law, ...] = ("neo_hookean", "st_venant_kirchhoff")

_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Material:
    """Homogeneous isotropic hyperelastic material; the defaults are the paper's liver tissue.

    Attributes
    ----------
    law
        Stored energy function.
    youngs_modulus_pa
        Young's modulus at small strain, pascals.
    poisson_ratio
        Poisson's ratio at small strain, above -1 and below 0.5.
    """

    law: Law = "neo_hookean"
    youngs_modulus_pa: float = 1700.0
    poisson_ratio: float = 0.35

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise InvalidInputError(f"material law must be one of {', '.join(LAWS)}, got {self.law!r}")
        if not self.youngs_modulus_pa > 0.0:
            raise InvalidInputError(f"Young's modulus must be positive, got {self.youngs_modulus_pa} Pa")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise InvalidInputError(f"Poisson's ratio must lie between -1 and 0.5, got {self.poisson_ratio}")

    @property
    def lame_pa(self) -> tuple[float, float]:
        """Lame's constants lambda and mu, pascals."""
        young, nu = self.youngs_modulus_pa, self.poisson_ratio
        return young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), young / (2.0 * (1.0 + nu))

    def energy(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return W, (...) J/m^3, for F (..., 3, 3); infinite where F is inverted."""
        f = deformation_gradient
        lam, mu = self.lame_pa
        det = determinant(f)
        if self.law == "neo_hookean":
            log_j = np.log(np.where(det > 0.0, det, 1.0))
            value = 0.5 * mu * (np.einsum("...iJ,...iJ->...", f, f) - 3.0) - mu * log_j + 0.5 * lam * log_j**2
        else:
            strain = _green_lagrange(f)
            trace = np.einsum("...II->...", strain)
            value = 0.5 * lam * trace**2 + mu * np.einsum("...IJ,...IJ->...", strain, strain)
        return np.where(det > 0.0, value, np.inf)

    def stress(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return P, (..., 3, 3) Pa, for F (..., 3, 3) with positive determinant."""
        f = deformation_gradient
        lam, mu = self.lame_pa
        if self.law == "neo_hookean":
            inverse_f, det = inverse(f)
            inverse_t = np.swapaxes(inverse_f, -1, -2)
            neo: FloatArray = mu * f + (lam * np.log(det) - mu)[..., None, None] * inverse_t
            return neo
        kirchhoff: FloatArray = np.einsum("...iK,...KJ->...iJ", f, self._second_piola_kirchhoff(f))
        return kirchhoff

    def tangent(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return A, (..., 3, 3, 3, 3) Pa, for F (..., 3, 3) with positive determinant."""
        f = deformation_gradient
        lam, mu = self.lame_pa
        if self.law == "neo_hookean":
            inverse_f, det = inverse(f)
            inverse_t = np.swapaxes(inverse_f, -1, -2)
            log_j = np.log(det)[..., None, None, None, None]
            neo: FloatArray = (
                mu * np.einsum("ik,JL->iJkL", _IDENTITY, _IDENTITY)
                + (mu - lam * log_j) * np.einsum("...iL,...kJ->...iJkL", inverse_t, inverse_t)
                + lam * np.einsum("...iJ,...kL->...iJkL", inverse_t, inverse_t)
            )
            return neo
        left = f @ np.swapaxes(f, -1, -2)
        kirchhoff: FloatArray = (
            np.einsum("ik,...JL->...iJkL", _IDENTITY, self._second_piola_kirchhoff(f))
            + lam * np.einsum("...iJ,...kL->...iJkL", f, f)
            + mu * np.einsum("...ik,JL->...iJkL", left, _IDENTITY)
            + mu * np.einsum("...iL,...kJ->...iJkL", f, f)
        )
        return kirchhoff

    def contracted_tangent(
        self, deformation_gradient: FloatArray, first: FloatArray, second: FloatArray
    ) -> FloatArray:
        """Return a_J A[i, J, k, L] b_L, (..., 3, 3), for vectors a and b, (..., 3): the stiffness of two vertices.

        The same as contracting `tangent`, without its 81 components.
        """
        f = deformation_gradient
        lam, mu = self.lame_pa
        along = np.einsum("...J,...J->...", first, second)
        if self.law == "neo_hookean":
            inverse_f, det = inverse(f)
            spatial_first = np.einsum("...J,...Ji->...i", first, inverse_f)
            spatial_second = np.einsum("...J,...Ji->...i", second, inverse_f)
            shear = (mu - lam * np.log(det))[..., None, None]
            blocks = lam * _outer(spatial_first, spatial_second) + shear * _outer(
                spatial_second, spatial_first
            )
            return _add_to_diagonal(blocks, mu * along)
        stress = self._second_piola_kirchhoff(f)
        spatial_first = np.einsum("...iJ,...J->...i", f, first)
        spatial_second = np.einsum("...iJ,...J->...i", f, second)
        left = np.einsum("...iK,...jK->...ij", f, f)
        blocks = lam * _outer(spatial_first, spatial_second) + mu * _outer(spatial_second, spatial_first)
        blocks = blocks + mu * along[..., None, None] * left
        traction = np.einsum("...JL,...L->...J", stress, second)
        return _add_to_diagonal(blocks, np.einsum("...J,...J->...", first, traction))

    def _second_piola_kirchhoff(self, f: FloatArray) -> FloatArray:
        lam, mu = self.lame_pa
        strain = _green_lagrange(f)
        trace = np.einsum("...II->...", strain)[..., None, None]
        result: FloatArray = lam * trace * _IDENTITY + 2.0 * mu * strain
        return result


def _green_lagrange(f: FloatArray) -> FloatArray:
    result: FloatArray = 0.5 * (np.einsum("...KI,...KJ->...IJ", f, f) - _IDENTITY)
    return result


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    result: FloatArray = a[..., :, None] * b[..., None, :]
    return result


def _add_to_diagonal(matrices: FloatArray, values: FloatArray) -> FloatArray:
    for i in range(3):
        matrices[..., i, i] += values
    return matrices
