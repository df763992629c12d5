"""Compressible Mooney-Rivlin tissue, the law of the phantom.

Stored energy, with F the deformation gradient, J = det F and the invariants of J^(-2/3) F^T F:

    W = c10 (I1 - 3) + c01 (I2 - 3) + kappa/2 (J - 1)^2

At small strain the shear modulus is 2 (c10 + c01) and the bulk modulus kappa.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from softtissue_estimator.errors import InvalidInputError


@dataclass(frozen=True)
class MooneyRivlin:
    """Constants of the law in pascals."""

    c10_pa: float
    c01_pa: float
    bulk_modulus_pa: float

    @property
    def constants(self) -> tuple[float, ...]:
        """See `softtissue_training.phantom.statics.Tissue`."""
        return self.c10_pa, self.c01_pa, self.bulk_modulus_pa

    @staticmethod
    def energy_density(deformation_gradient: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
        """See `energy_density` of this module."""
        return energy_density(deformation_gradient, constants)

    @staticmethod
    def stress_and_tangent(f: torch.Tensor, constants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See `stress_and_tangent` of this module."""
        return stress_and_tangent(f, constants)


def mooney_rivlin(youngs_modulus_pa: float, poisson_ratio: float, share_c01: float = 0.25) -> MooneyRivlin:
    """Choose the constants that give this Young's modulus and Poisson's ratio at small strain.

    Raises
    ------
    InvalidInputError
        If the modulus is not positive or Poisson's ratio not within (0, 0.5).
    """
    if youngs_modulus_pa <= 0.0 or not 0.0 < poisson_ratio < 0.5:
        raise InvalidInputError(
            f"expected E > 0 Pa and 0 < nu < 0.5, got E = {youngs_modulus_pa} Pa and nu = {poisson_ratio}"
        )
    shear = youngs_modulus_pa / (2.0 * (1.0 + poisson_ratio))
    bulk = youngs_modulus_pa / (3.0 * (1.0 - 2.0 * poisson_ratio))
    return MooneyRivlin(0.5 * shear * (1.0 - share_c01), 0.5 * shear * share_c01, bulk)


def energy_density(deformation_gradient: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
    """Return the stored energy (J/m^3) of one deformation gradient ``(3, 3)``; constants c10, c01, kappa in Pa."""
    c = deformation_gradient.T @ deformation_gradient
    volume_squared = torch.exp(torch.logdet(c))  # the second derivative of torch.det is not finite at F = I
    first = torch.trace(c)
    second = 0.5 * (first**2 - torch.trace(c @ c))
    isochoric = constants[0] * (volume_squared ** (-1.0 / 3.0) * first - 3.0)
    isochoric = isochoric + constants[1] * (volume_squared ** (-2.0 / 3.0) * second - 3.0)
    return isochoric + 0.5 * constants[2] * (torch.sqrt(volume_squared) - 1.0) ** 2


def stress_and_tangent(f: torch.Tensor, constants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """First and second derivative of `energy_density`, written out (thirty times faster than differentiating it).

    Parameters
    ----------
    f : (n, 3, 3) deformation gradients
    constants : (n, 3) c10, c01 and kappa, Pa

    Returns
    -------
    stress : (n, 3, 3) first Piola-Kirchhoff stress, Pa
    tangent : (n, 3, 3, 3, 3) its derivative by the deformation gradient, Pa
    """
    c10, c01, kappa = (constants[:, i, None, None] for i in range(3))
    g = torch.linalg.inv(f).transpose(1, 2)
    c, left = f.transpose(1, 2) @ f, f @ f.transpose(1, 2)
    j = torch.linalg.det(f)[:, None, None]
    first = torch.einsum("nii->n", c)[:, None, None]
    second = 0.5 * (first**2 - torch.sum(c * c, dim=(1, 2), keepdim=True))
    h = first * f - f @ c
    # A negative determinant is rejected by the caller; its absolute value keeps the powers finite.
    a, b = c10 * j.abs() ** (-2.0 / 3.0), c01 * j.abs() ** (-4.0 / 3.0)
    p1, p2 = a * (2.0 * f - 2.0 / 3.0 * first * g), b * (2.0 * h - 4.0 / 3.0 * second * g)
    stress = p1 + p2 + kappa * (j**2 - j) * g

    def outer(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.einsum("niJ,nkL->niJkL", x, y)

    eye = torch.eye(3, dtype=f.dtype, device=f.device).expand_as(f)
    tangent = -2.0 / 3.0 * outer(p1 + 2.0 * p2, g) - 4.0 / 3.0 * outer(a * g, f) - 8.0 / 3.0 * outer(b * g, h)
    tangent += outer(4.0 * b * f, f) + outer(kappa * (2.0 * j**2 - j) * g, g)
    crossed = 2.0 / 3.0 * a * first + 4.0 / 3.0 * b * second - kappa * (j**2 - j)
    tangent += torch.einsum("niL,nkJ->niJkL", crossed * g, g) - torch.einsum("niL,nkJ->niJkL", 2.0 * b * f, f)
    tangent += torch.einsum("nik,nJL->niJkL", eye, 2.0 * (a + b * first) * eye - 2.0 * b * c)
    tangent -= torch.einsum("nik,nJL->niJkL", 2.0 * b * left, eye)
    return stress, tangent
