"""The paper's 3D U-Net (Pfeiffer et al. 2019, section "Network architecture"), as a function of tensors alone.

The channel counts stand in a figure that the text does not give; the defaults satisfy every sentence of the text:
9.08 million parameters, average pooling from 64 to 8 cells a side, and a receptive field that reaches from every cell
to every other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from softtissue_estimator.errors import InvalidInputError


@dataclass(frozen=True)
class UNetArchitecture:
    """Everything that decides the shapes of the weights.

    Attributes
    ----------
    in_channels, out_channels
        Channels of the input grid and of every output.
    widths
        Feature maps at full, 1/2, 1/4 and 1/8 resolution.
    encoder_convolutions, bottleneck_convolutions, decoder_convolutions
        Convolutions a level.
    """

    in_channels: int = 5
    out_channels: int = 3
    widths: tuple[int, ...] = (32, 64, 64, 256)
    encoder_convolutions: int = 2
    bottleneck_convolutions: int = 5
    decoder_convolutions: int = 2

    @property
    def multiple(self) -> int:
        """Cell counts of the input must be multiples of this."""
        return 1 << (len(self.widths) - 1)


class UNet(nn.Module):
    """U-Net with an output at every resolution; every convolution is 3^3 with padding 1, followed by SoftSign."""

    def __init__(self, architecture: UNetArchitecture | None = None) -> None:
        super().__init__()
        self.architecture = architecture or UNetArchitecture()
        spec = self.architecture
        widths = spec.widths
        self.encoder = nn.ModuleList()
        # A module for every level, so that each can be prepared for its own input (`inference.runtime`).
        self.pools = nn.ModuleList()
        incoming = spec.in_channels
        for width in widths[:-1]:
            self.encoder.append(_level(incoming, width, spec.encoder_convolutions))
            self.pools.append(nn.AvgPool3d(2))
            incoming = width
        self.bottleneck = _level(incoming, widths[-1], spec.bottleneck_convolutions)
        self.decoder = nn.ModuleList()
        self.heads = nn.ModuleList([_convolution(widths[-1], spec.out_channels)])
        incoming = widths[-1]
        for width in reversed(widths[:-1]):
            self.decoder.append(_level(incoming + width, width, spec.decoder_convolutions))
            self.heads.append(_convolution(width, spec.out_channels))
            incoming = width

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the displacement at full resolution.

        Parameters
        ----------
        inputs
            (B, in_channels, X, Y, Z), scaled as `network_input` does; X, Y and Z multiples of 8.

        Returns
        -------
        Tensor
            (B, out_channels, X, Y, Z) in the network's unit of length.
        """
        output: Tensor = self.heads[-1](self._features(inputs)[-1])
        return output

    def forward_all(self, inputs: Tensor) -> list[Tensor]:
        """Return the outputs at 1/8, 1/4, 1/2 and full resolution, coarsest first (the loss sums over them)."""
        return [head(feature) for head, feature in zip(self.heads, self._features(inputs), strict=True)]

    def _features(self, inputs: Tensor) -> list[Tensor]:
        self._check(inputs)
        skips: list[Tensor] = []
        feature = inputs
        for level, pool in zip(self.encoder, self.pools, strict=True):
            feature = level(feature)
            skips.append(feature)
            feature = pool(feature)
        feature = self.bottleneck(feature)
        features = [feature]
        for level, skip in zip(self.decoder, reversed(skips), strict=True):
            upsampled = functional.interpolate(feature, scale_factor=2, mode="nearest")
            feature = level(torch.cat([upsampled, skip], dim=1))
            features.append(feature)
        return features

    def _check(self, inputs: Tensor) -> None:
        spec = self.architecture
        if inputs.ndim != 5 or inputs.shape[1] != spec.in_channels:
            raise InvalidInputError(
                f"the network takes (B, {spec.in_channels}, X, Y, Z), got {tuple(inputs.shape)}"
            )
        if any(cells % spec.multiple for cells in inputs.shape[2:]):
            raise InvalidInputError(
                f"cell counts must be multiples of {spec.multiple}, got {tuple(inputs.shape[2:])}"
            )


def _convolution(incoming: int, outgoing: int) -> nn.Conv3d:
    return nn.Conv3d(incoming, outgoing, kernel_size=3, padding=1)


def _level(incoming: int, width: int, convolutions: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(convolutions):
        layers += [_convolution(incoming, width), nn.Softsign()]
        incoming = width
    return nn.Sequential(*layers)


def parameter_count(network: nn.Module) -> int:
    """Return the number of trainable weights.

    Examples
    --------
    >>> parameter_count(UNet())
    9080844
    """
    return sum(weight.numel() for weight in network.parameters() if weight.requires_grad)


@torch.no_grad()
def initialise(
    network: UNet, example: Tensor, *, generator: torch.Generator, head_gain: float = 0.1
) -> dict[str, float]:
    """Give every convolution's output unit standard deviation on an example (LSUV, Mishkin and Matas 2016).

    PyTorch's default shrinks a signal by about the square root of 3 a layer, and SoftSign never amplifies, so that a
    network of this depth starts, and stays, at zero output.

    Parameters
    ----------
    network
        Changed in place.
    example
        (B, in_channels, X, Y, Z) typical inputs.
    generator
        Source of the random weights.
    head_gain
        Standard deviation of the outputs, small so that training starts near zero displacement.

    Returns
    -------
    dict[str, float]
        Standard deviation of each convolution's output after the rescaling, by module name.
    """
    heads = set(network.heads)
    reached: dict[str, float] = {}
    for module in network.modules():
        if isinstance(module, nn.Conv3d):
            fan_in = module.weight[0].numel()
            module.weight.normal_(0.0, fan_in**-0.5, generator=generator)
            if module.bias is not None:
                module.bias.zero_()
    # named_modules lists the encoder, the bottleneck and the decoder in the order in which signals pass them.
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv3d) and module not in heads:
            module.weight.div_(max(_output_std(network, module, example), 1e-6))
            reached[name] = _output_std(network, module, example)
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv3d) and module in heads:
            module.weight.mul_(head_gain / max(_output_std(network, module, example), 1e-6))
            reached[name] = _output_std(network, module, example)
    return reached


def _output_std(network: UNet, module: nn.Conv3d, example: Tensor) -> float:
    measured: list[float] = []

    def measure(_: nn.Module, __: Sequence[Tensor], output: Tensor) -> None:
        measured.append(float(output.float().std()))

    handle = module.register_forward_hook(measure)
    try:
        network.forward_all(example)
    finally:
        handle.remove()
    return measured[-1]
