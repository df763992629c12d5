"""The hybrid network: a small 3D U-Net for the remainder after the elastic posterior, and how sure it is of it.

It is a function of tensors alone. Its output weights start at zero, so that training begins exactly at the elastic
posterior (`input.remainder`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from softtissue_estimator.errors import InvalidInputError

OUTPUTS = 4  # three components of the remainder, and the logarithm of the change of the standard deviation


@dataclass(frozen=True)
class HybridArchitecture:
    """Everything that decides the shapes of the weights.

    Attributes
    ----------
    in_channels
        Channels of the input grid.
    widths
        Feature maps at full, 1/2, 1/4, ... resolution; multiples of `groups`.
    encoder_convolutions, bottleneck_convolutions, decoder_convolutions
        Convolutions a level, each 3^3 with padding 1, group normalisation (Wu and He 2018) and SiLU.
    groups
        Groups of channels that are normalised together; 0 for no normalisation.
    """

    in_channels: int = 10
    widths: tuple[int, ...] = (16, 32, 64)
    encoder_convolutions: int = 2
    bottleneck_convolutions: int = 3
    decoder_convolutions: int = 2
    groups: int = 4

    @property
    def multiple(self) -> int:
        """Cell counts of the input must be multiples of this."""
        return 1 << (len(self.widths) - 1)


class HybridNetwork(nn.Module):
    """U-Net with one output at full resolution; trilinear upsampling, skip connections by concatenation."""

    def __init__(self, architecture: HybridArchitecture) -> None:
        super().__init__()
        self.architecture = spec = architecture
        self.encoder = nn.ModuleList()
        # A module for every level, so that each can be prepared for its own input (`inference.runtime`).
        self.pools = nn.ModuleList()
        incoming = spec.in_channels
        for width in spec.widths[:-1]:
            self.encoder.append(_level(incoming, width, spec.encoder_convolutions, spec.groups))
            self.pools.append(nn.AvgPool3d(2))
            incoming = width
        self.bottleneck = _level(incoming, spec.widths[-1], spec.bottleneck_convolutions, spec.groups)
        incoming = spec.widths[-1]
        self.decoder = nn.ModuleList()
        for width in reversed(spec.widths[:-1]):
            self.decoder.append(_level(incoming + width, width, spec.decoder_convolutions, spec.groups))
            incoming = width
        self.heads = nn.ModuleList([nn.Conv3d(incoming, OUTPUTS, kernel_size=1)])

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (B, 4, X, Y, Z) for inputs (B, in_channels, X, Y, Z) scaled as `input` does."""
        self._check(inputs)
        skips: list[Tensor] = []
        feature = inputs
        for level, pool in zip(self.encoder, self.pools, strict=True):
            feature = level(feature)
            skips.append(feature)
            feature = pool(feature)
        feature = self.bottleneck(feature)
        for level, skip in zip(self.decoder, reversed(skips), strict=True):
            upsampled = functional.interpolate(feature, scale_factor=2, mode="trilinear", align_corners=False)
            feature = level(torch.cat([upsampled, skip], dim=1))
        output: Tensor = self.heads[0](feature)
        return output

    def _check(self, inputs: Tensor) -> None:
        spec = self.architecture
        if inputs.ndim != 5 or inputs.shape[1] != spec.in_channels:
            raise InvalidInputError(
                f"the hybrid network takes (B, {spec.in_channels}, X, Y, Z), got {tuple(inputs.shape)}"
            )
        if any(cells % spec.multiple for cells in inputs.shape[2:]):
            raise InvalidInputError(
                f"cell counts must be multiples of {spec.multiple}, got {tuple(inputs.shape[2:])}"
            )


def _level(incoming: int, width: int, convolutions: int, groups: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(convolutions):
        layers.append(nn.Conv3d(incoming, width, kernel_size=3, padding=1, bias=groups == 0))
        if groups:
            layers.append(nn.GroupNorm(groups, width))
        layers.append(nn.SiLU())
        incoming = width
    return nn.Sequential(*layers)


@torch.no_grad()
def initialise(network: HybridNetwork, generator: torch.Generator) -> None:
    """Draw the weights (He et al. 2015); those of the output are zero.

    Parameters
    ----------
    network
        Changed in place.
    generator
        Source of the random weights, on the network's device.
    """
    for module in network.modules():
        if isinstance(module, nn.Conv3d):
            fan_in = module.weight[0].numel()
            module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
            if module.bias is not None:
                module.bias.zero_()
    for parameter in network.heads.parameters():
        parameter.zero_()
