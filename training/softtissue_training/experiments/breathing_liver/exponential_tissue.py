"""Nearly incompressible tissue that stiffens exponentially when it is strained, after Fung and Demiray.

Stored energy, with F the deformation gradient, J = det F and I1 the trace of J^(-2/3) F^T F:

    W = mu / (2 b) (exp(b (I1 - 3)) - 1) + kappa/4 (J^2 - 1 - 2 ln J)

(H. Demiray, *A note on the elasticity of soft biological tissues*, J. Biomech. 1972). At small strain the shear
modulus is mu and the bulk modulus kappa. Neither the training data nor the phantom are made of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from softtissue_estimator.errors import InvalidInputError


@dataclass(frozen=True)
class ExponentialTissue:
    """Constants of the law; a `softtissue_training.phantom.statics.Tissue`.

    Attributes
    ----------
    shear_modulus_pa
        mu, at small strain.
    stiffening
        b, without unit.
    bulk_modulus_pa
        kappa.
    """

    shear_modulus_pa: float
    stiffening: float
    bulk_modulus_pa: float

    @property
    def constants(self) -> tuple[float, ...]:
        """See `softtissue_training.phantom.statics.Tissue`."""
        return self.shear_modulus_pa, self.stiffening, self.bulk_modulus_pa

    @staticmethod
    def energy_density(deformation_gradient: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
        """Return the stored energy (J/m^3) of one deformation gradient ``(3, 3)``."""
        shear, stiffening, bulk = constants
        c = deformation_gradient.T @ deformation_gradient
        log_volume = 0.5 * torch.logdet(c)
        first = torch.exp(-2.0 / 3.0 * log_volume) * torch.trace(c)
        isochoric: torch.Tensor = shear / (2.0 * stiffening) * torch.expm1(stiffening * (first - 3.0))
        volumetric: torch.Tensor = 0.25 * bulk * (torch.exp(2.0 * log_volume) - 1.0 - 2.0 * log_volume)
        return isochoric + volumetric

    @staticmethod
    def stress_and_tangent(f: torch.Tensor, constants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """First and second derivative of `energy_density`, written out.

        Parameters
        ----------
        f : (n, 3, 3) deformation gradients
        constants : (n, 3) mu (Pa), b and kappa (Pa)

        Returns
        -------
        stress : (n, 3, 3) first Piola-Kirchhoff stress, Pa
        tangent : (n, 3, 3, 3, 3) its derivative by the deformation gradient, Pa
        """
        shear, stiffening, bulk = (constants[:, i, None, None] for i in range(3))
        g = torch.linalg.inv(f).transpose(1, 2)
        j = torch.linalg.det(f)[:, None, None]
        # A negative determinant is rejected by the caller; its absolute value keeps the powers finite.
        scale = j.abs() ** (-2.0 / 3.0)
        trace = torch.sum(f * f, dim=(1, 2), keepdim=True)
        slope = 0.5 * shear * torch.exp(stiffening * (scale * trace - 3.0))  # dW / dI1
        first = scale * (2.0 * f - 2.0 / 3.0 * trace * g)  # dI1 / dF
        stress = slope * first + 0.5 * bulk * (j**2 - 1.0) * g

        def outer(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
            return torch.einsum("niJ,nkL->niJkL", x, y)

        eye = torch.eye(3, dtype=f.dtype, device=f.device).expand_as(f)
        tangent = outer(stiffening * slope * first, first) - 2.0 / 3.0 * outer(slope * first, g)
        tangent += outer(bulk * j**2 * g, g) - 4.0 / 3.0 * outer(slope * scale * g, f)
        crossed = 2.0 / 3.0 * slope * scale * trace - 0.5 * bulk * (j**2 - 1.0)
        tangent += torch.einsum("niL,nkJ->niJkL", crossed * g, g)
        tangent += torch.einsum("nik,nJL->niJkL", 2.0 * slope * scale * eye, eye)
        return stress, tangent


def exponential_tissue(
    youngs_modulus_pa: float, poisson_ratio: float, stiffening: float
) -> ExponentialTissue:
    """Choose the constants that give this Young's modulus and Poisson's ratio at small strain.

    Raises
    ------
    InvalidInputError
        If the modulus or the stiffening is not positive, or Poisson's ratio not within (0, 0.5).
    """
    if youngs_modulus_pa <= 0.0 or not 0.0 < poisson_ratio < 0.5 or stiffening <= 0.0:
        raise InvalidInputError(
            f"expected E > 0 Pa, 0 < nu < 0.5 and stiffening > 0, got E = {youngs_modulus_pa} Pa, "
            f"nu = {poisson_ratio} and stiffening {stiffening}"
        )
    return ExponentialTissue(
        youngs_modulus_pa / (2.0 * (1.0 + poisson_ratio)),
        stiffening,
        youngs_modulus_pa / (3.0 * (1.0 - 2.0 * poisson_ratio)),
    )
