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
from softtissue_training.physics.small_matrices import determinant, inverse

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
        lam, _ = self.lame_pa
        strain = self.volumetric_strain(deformation_gradient)
        result: FloatArray = self.shear_energy(deformation_gradient) + 0.5 * lam * strain**2
        return result

    def shear_energy(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return W without the term of lambda, (...) J/m^3, for F (..., 3, 3); infinite where F is inverted."""
        f = deformation_gradient
        _, mu = self.lame_pa
        det = determinant(f)
        if self.law == "neo_hookean":
            value = 0.5 * mu * (np.einsum("...iJ,...iJ->...", f, f) - 3.0) - mu * _log(det)
        else:
            strain = _green_lagrange(f)
            value = mu * np.einsum("...IJ,...IJ->...", strain, strain)
        return np.where(det > 0.0, value, np.inf)

    def volumetric_strain(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return theta, (...), for F (..., 3, 3): the term of lambda in W is lambda/2 theta^2; zero where inverted."""
        if self.law == "neo_hookean":
            return _log(determinant(deformation_gradient))
        result: FloatArray = np.einsum("...II->...", _green_lagrange(deformation_gradient))
        return result

    def volumetric_gradient(self, deformation_gradient: FloatArray) -> FloatArray:
        """Return d theta / dF, (..., 3, 3), for F (..., 3, 3) with positive determinant."""
        if self.law == "neo_hookean":
            return np.swapaxes(inverse(deformation_gradient)[0], -1, -2)
        return deformation_gradient

    def stress(self, deformation_gradient: FloatArray, pressure: FloatArray | None = None) -> FloatArray:
        """Return P, (..., 3, 3) Pa, for F (..., 3, 3) with positive determinant.

        Parameters
        ----------
        deformation_gradient
            F.
        pressure
            (...) Pa, positive in tension, that stands for lambda theta; None computes it from F.
        """
        f = deformation_gradient
        _, mu = self.lame_pa
        if self.law == "neo_hookean":
            inverse_f, det = inverse(f)
            inverse_t = np.swapaxes(inverse_f, -1, -2)
            if pressure is None:
                pressure = self._pressure(np.log(det))
            neo: FloatArray = mu * f + (pressure - mu)[..., None, None] * inverse_t
            return neo
        kirchhoff: FloatArray = np.einsum("...iK,...KJ->...iJ", f, self._second_piola_kirchhoff(f, pressure))
        return kirchhoff

    def tangent(self, deformation_gradient: FloatArray, pressure: FloatArray | None = None) -> FloatArray:
        """Return A, (..., 3, 3, 3, 3) Pa, for F (..., 3, 3) with positive determinant.

        Parameters
        ----------
        deformation_gradient
            F.
        pressure
            (...) Pa, positive in tension, that stands for lambda theta and does not change with F; None is the material
            itself.
        """
        f = deformation_gradient
        lam, mu = self.lame_pa
        if self.law == "neo_hookean":
            inverse_f, det = inverse(f)
            normal = np.swapaxes(inverse_f, -1, -2)
            shear = mu - (self._pressure(np.log(det)) if pressure is None else pressure)
            result: FloatArray = mu * np.einsum("ik,JL->iJkL", _IDENTITY, _IDENTITY) + shear[
                ..., None, None, None, None
            ] * np.einsum("...iL,...kJ->...iJkL", normal, normal)
        else:
            normal = f
            left = f @ np.swapaxes(f, -1, -2)
            result = (
                np.einsum("ik,...JL->...iJkL", _IDENTITY, self._second_piola_kirchhoff(f, pressure))
                + mu * np.einsum("...ik,JL->...iJkL", left, _IDENTITY)
                + mu * np.einsum("...iL,...kJ->...iJkL", f, f)
            )
        if pressure is None:
            result = result + lam * np.einsum("...iJ,...kL->...iJkL", normal, normal)
        return result

    def contracted_tangent(
        self,
        deformation_gradient: FloatArray,
        first: FloatArray,
        second: FloatArray,
        pressure: FloatArray | None = None,
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
            shear = mu - (self._pressure(np.log(det)) if pressure is None else pressure)
            blocks = shear[..., None, None] * _outer(spatial_second, spatial_first)
            diagonal = mu * along
        else:
            spatial_first = np.einsum("...iJ,...J->...i", f, first)
            spatial_second = np.einsum("...iJ,...J->...i", f, second)
            blocks = mu * _outer(spatial_second, spatial_first)
            traction = np.einsum("...JL,...L->...J", self._second_piola_kirchhoff(f, pressure), second)
            diagonal = np.einsum("...J,...J->...", first, traction)
        if pressure is None:
            blocks += lam * _outer(spatial_first, spatial_second)
        if self.law == "st_venant_kirchhoff":
            blocks += mu * along[..., None, None] * np.einsum("...iK,...jK->...ij", f, f)
        for i in range(3):
            blocks[..., i, i] += diagonal
        return blocks

    def _second_piola_kirchhoff(self, f: FloatArray, pressure: FloatArray | None) -> FloatArray:
        _, mu = self.lame_pa
        strain = _green_lagrange(f)
        if pressure is None:
            pressure = self._pressure(np.einsum("...II->...", strain))
        result: FloatArray = pressure[..., None, None] * _IDENTITY + 2.0 * mu * strain
        return result

    def _pressure(self, volumetric_strain: FloatArray) -> FloatArray:
        lam, _ = self.lame_pa
        result: FloatArray = lam * volumetric_strain
        return result


def _log(det: FloatArray) -> FloatArray:
    result: FloatArray = np.log(np.where(det > 0.0, det, 1.0))
    return result


def _green_lagrange(f: FloatArray) -> FloatArray:
    result: FloatArray = 0.5 * (np.einsum("...KI,...KJ->...IJ", f, f) - _IDENTITY)
    return result


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    result: FloatArray = a[..., :, None] * b[..., None, :]
    return result
