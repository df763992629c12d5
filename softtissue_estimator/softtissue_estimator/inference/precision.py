"""In which floating-point format a network computes."""

from __future__ import annotations

import torch

from softtissue_estimator.errors import InvalidInputError

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


def choose_precision(name: str, device: torch.device) -> torch.dtype:
    """Return the format for the parameter `precision`.

    'auto' is float16 on GPUs and on processors that multiply matrices of it (AMX-FP16), bfloat16 on those that do so
    with bfloat16 alone (AMX), and float32 elsewhere: without such units half precision takes longer, whatever other
    instructions there are (docs/explanation/networks.md). The networks' activations are bounded or normalised, so that
    float16's range is wide enough for them.

    Raises
    ------
    InvalidInputError
        The name is unknown, or the device has no instructions for the format.
    """
    if name == "auto":
        return _fastest(device)
    if name not in PRECISIONS:
        raise InvalidInputError(
            f"parameter precision: expected one of auto, {', '.join(PRECISIONS)}, got {name!r}"
        )
    if not computes_in(name, device):
        raise InvalidInputError(
            f"parameter precision: expected a format that the device computes in, got {name!r} on {device} without "
            "instructions for it"
        )
    return PRECISIONS[name]


def _fastest(device: torch.device) -> torch.dtype:
    if device.type == "cuda":
        return torch.float16
    for name, unit in (("float16", "amx_fp16"), ("bfloat16", "amx_tile")):
        if computes_in(name, device) and _cpu_has(unit):
            return PRECISIONS[name]
    return torch.float32


def precision_name(dtype: torch.dtype) -> str:
    """Return the name of a format, as the parameter has it.

    Examples
    --------
    >>> precision_name(torch.float16)
    'float16'
    """
    return str(dtype).removeprefix("torch.")


def computes_in(name: str, device: torch.device) -> bool:
    """Return whether a device has instructions for a format of `PRECISIONS`; without them it would be slow."""
    if name == "float32":
        return True
    if device.type == "cuda":
        return name == "float16" or bool(torch.cuda.is_bf16_supported(including_emulation=False))
    if device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return False
    if name == "bfloat16":
        return _cpu_has("avx512_bf16") or _cpu_has("amx_tile")
    return _cpu_has("avx512_fp16") or _cpu_has("amx_fp16")


def _cpu_has(instructions: str) -> bool:
    """Ask torch, which has no public way before `get_capabilities`; a version that cannot say so means no."""
    capabilities = getattr(torch.cpu, "get_capabilities", None)
    if capabilities is not None:
        return bool(capabilities().get(instructions, False))
    return bool(getattr(torch.cpu, f"_is_{instructions}_supported", lambda: False)())
