"""Where a network may compute in bfloat16."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.network import UNet
from softtissue_estimator.inference.precision import computes_in

PRECISIONS = ("auto", "float32", "bfloat16")


def choose_bfloat16(name: str, device: torch.device) -> bool:
    """Return whether convolutions run in bfloat16.

    Parameters
    ----------
    name
        One of `PRECISIONS`; 'auto': bfloat16 where the device has instructions for it.

    Raises
    ------
    InvalidInputError
        The name is none of these, or the device cannot do it.
    """
    if name not in PRECISIONS:
        raise InvalidInputError(f"the precision must be one of {', '.join(PRECISIONS)}, got {name!r}")
    able = has_bfloat16(device)
    if name == "bfloat16" and not able:
        raise InvalidInputError(
            f"bfloat16 needs a GPU of 2020 or later or a processor with AVX-512 BF16 or AMX, got {device} without"
        )
    return able and name != "float32"


def has_bfloat16(device: torch.device) -> bool:
    """Return whether a device has instructions for bfloat16; without them it would be slower than float32."""
    return computes_in("bfloat16", device)


def restrict_autocast(network: UNet, device: torch.device) -> None:
    """Keep the outputs of a network in float32, and on a CPU its coarse levels too, whatever autocast says.

    An output of 40 mm in bfloat16 would be rounded to 0.2 mm. With torch 2.13 and AVX-512, the gradients of bfloat16
    convolutions on grids of 2 x 2 x 2 and 4 x 4 x 4 cells are now and then garbage. Most of the work is at full and
    half resolution, which bfloat16 makes about 1.5 times faster.
    """
    exempt: list[nn.Module] = list(network.heads)
    if device.type == "cpu":
        exempt += [*network.encoder[2:], network.bottleneck, *network.decoder[:-2]]
    for module in exempt:
        _exempt(module)


def _exempt(module: nn.Module) -> None:
    forward = module.forward

    def without_autocast(inputs: Tensor) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            output: Tensor = forward(inputs.float())
        return output

    module.forward = without_autocast
