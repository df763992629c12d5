"""The law of the tetrahedra: stress and stiffness of each, from its deformation gradient F.

W = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2, J = det F, the law that the simulations of `softtissue_training`
use by default. Elements that have collapsed, or are inverted by an extrapolation, follow the corotated linear law
W = mu |S - I|^2 + lambda/2 tr(S - I)^2, F = R S, instead: it is finite everywhere and leads them back.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.averaged_volume import AveragedVolume

COLLAPSED_VOLUME_RATIO = 0.2
"""det F below which an element follows the corotated law: the neo-Hookean one grows without bound towards zero."""


@dataclass(frozen=True, eq=False)
class ElementResponse:
    """What forces and stiffness of all elements are made of.

    Parameters
    ----------
    stress : (m, 3, 3) float64
        First Piola-Kirchhoff stress over Young's modulus.
    spatial : (m, 4, 3) float64
        a: gradients of the shape functions in space.
    coefficient : (m,) float64
        c: the stiffness between corners i and j is V (c a_j a_i^T + mu g_i . g_j I), and lambda's part.
    own : (m,) bool
        Elements whose lambda's part is their own, V lambda a_i a_j^T; that of the others is averaged.
    """

    stress: Tensor
    spatial: Tensor
    coefficient: Tensor
    own: Tensor


class NeoHookeanElements:
    """The elements of a mesh under this law.

    Parameters
    ----------
    shape_gradients : (m, 4, 3) float64 1/m
        Gradients g of the shape functions at rest.
    averaged : AveragedVolume
        How the volumetric strain is averaged at the nodes.
    """

    def __init__(self, shape_gradients: Tensor, averaged: AveragedVolume) -> None:
        self._gradients, self._averaged = shape_gradients, averaged
        self._identity = torch.eye(3, dtype=torch.float64, device=shape_gradients.device)

    def response(self, gradient: Tensor, lame: float, shear: float) -> ElementResponse:
        """Stress and stiffness of all elements; collapsed ones follow the corotated law.

        Parameters
        ----------
        gradient : (m, 3, 3) float64
            F of each.
        lame, shear : float
            lambda and mu over Young's modulus.
        """
        collapsed = determinant(gradient) < COLLAPSED_VOLUME_RATIO
        sound = torch.where(collapsed[:, None, None], self._identity, gradient)
        cofactor, volume = _cofactor(sound)
        coefficient = shear - self._averaged.pressure(torch.log(volume), lame)
        inverse = cofactor / volume[:, None, None]  # transposed
        stress = shear * sound - coefficient[:, None, None] * inverse
        elements = ElementResponse(stress, self._gradients @ inverse.transpose(1, 2), coefficient, collapsed)
        if bool(collapsed.any()):
            other = self._corotated(gradient[collapsed], self._gradients[collapsed], lame, shear)
            elements.stress[collapsed] = other.stress
            elements.spatial[collapsed] = other.spatial
            elements.coefficient[collapsed] = other.coefficient
        return elements

    def stress(self, gradient: Tensor, lame: float, shear: float) -> Tensor:
        """Return the stress (m, 3, 3) of `response` alone, in half the time; parameters as of that."""
        cofactor, volume = _cofactor(gradient)
        if bool((volume < COLLAPSED_VOLUME_RATIO).any()):
            return self.response(gradient, lame, shear).stress
        coefficient = shear - self._averaged.pressure(torch.log(volume), lame)
        return torch.addcmul(shear * gradient, (coefficient / volume)[:, None, None], cofactor, value=-1.0)

    def corotated(self, gradient: Tensor, lame: float, shear: float) -> ElementResponse:
        """Stress and stiffness where all elements follow the corotated law; parameters as of `response`."""
        return self._corotated(gradient, self._gradients, lame, shear)

    def _corotated(
        self, gradient: Tensor, shape_gradient: Tensor, lame: float, shear: float
    ) -> ElementResponse:
        """Corotated law of some elements, the change of the rotation left out of the stiffness."""
        left, _, right = torch.linalg.svd(gradient)
        # A rotation, not a reflection: the direction that is compressed most is turned.
        left[:, :, 2] *= determinant(left @ right)[:, None]
        turn = left @ right
        strain = turn.transpose(1, 2) @ gradient - self._identity
        strain = 0.5 * (strain + strain.transpose(1, 2))
        trace = strain.diagonal(dim1=1, dim2=2).sum(dim=1)
        inner = 2.0 * shear * strain + (lame * trace)[:, None, None] * self._identity
        spatial = shape_gradient @ turn.transpose(1, 2)
        own = torch.ones_like(trace, dtype=torch.bool)
        return ElementResponse(turn @ inner, spatial, torch.full_like(trace, shear), own)


def determinant(matrices: Tensor) -> Tensor:
    """Return the determinants (m,) of matrices (m, 3, 3), without a factorisation, which takes longer."""
    first, second, third = matrices.unbind(1)
    found: Tensor = (first * torch.linalg.cross(second, third)).sum(dim=1)
    return found


def _cofactor(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cofactors (m, 3, 3) of matrices and their determinants (m,): over these, the inverses transposed."""
    first, second, third = matrices.unbind(1)
    across = torch.linalg.cross(second, third)
    found = torch.stack([across, torch.linalg.cross(third, first), torch.linalg.cross(first, second)], dim=1)
    return found, (first * across).sum(dim=1)
