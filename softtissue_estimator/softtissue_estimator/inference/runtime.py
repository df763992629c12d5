"""A network made ready to run many times on one shape of input.

torch computes small three-dimensional convolutions on a CPU without oneDNN, several times slower than with it. Here
every convolution goes to oneDNN, its weights reordered once into the layout that it wants, in the format that the
processor is fastest at; channels lie together in memory. A GPU gets the format and the memory layout alone. What makes
no difference to a network in training, and would only complicate it, is so kept apart from it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import torch
from torch import Tensor, nn

from softtissue_estimator.inference.precision import precision_name

_MOST_DIFFERENCE = 0.05  # of the largest output; bfloat16 stays below a fiftieth


class NetworkRuntime:
    """A network on one device, in one format, for one shape of input.

    Parameters
    ----------
    network
        In evaluation mode, float32; stays as it is.
    shape
        (B, C, X, Y, Z) of the inputs to come.
    device
        Where they are.
    dtype
        Format in which convolutions multiply; sums are float32 in all of them.
    progress
        Told in a sentence if this device cannot run the network so. It then runs as any module does, in float32.

    Attributes
    ----------
    description
        What was chosen, for a log.
    """

    def __init__(
        self,
        network: nn.Module,
        shape: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
        progress: Callable[[str], None],
    ) -> None:
        self._device = device
        plain = copy.deepcopy(network).to(device)
        # Random numbers reach every weight; the same ones, so that an installation behaves alike at every start.
        example = torch.randn(tuple(shape), generator=torch.Generator().manual_seed(0)).to(device)
        self._network, self._dtype = plain, torch.float32
        self.description = "float32"
        with torch.inference_mode():
            expected = self(example)
            try:
                self._network, self._dtype = _prepared(plain, example, dtype), dtype
                difference = float(
                    (self(example) - expected).abs().max() / expected.abs().max().clamp_min(1e-9)
                )
                if not difference <= _MOST_DIFFERENCE:
                    raise RuntimeError(f"its outputs are off by {difference:.2g} of the largest one")
                self.description = precision_name(dtype)
            # The operators are torch's own but not among those that it promises to keep.
            except (RuntimeError, AttributeError, NotImplementedError, TypeError) as error:
                self._network, self._dtype = plain, torch.float32
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                progress(
                    f"network in {precision_name(dtype)} cannot be used on {device} ({reason}); it runs unprepared"
                )

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return the network's output, float32, of inputs (B, C, X, Y, Z) float32 of the shape given before."""
        given = inputs.to(self._dtype, memory_format=torch.channels_last_3d)
        # The fastest algorithm of a GPU is searched for in the first calls, which are made before any frame.
        search = torch.backends.cudnn.flags(enabled=True, benchmark=True)
        with search if self._device.type == "cuda" else nullcontext():
            output: Tensor = self._network(given)
        return output.float()


def _prepared(network: nn.Module, example: Tensor, dtype: torch.dtype) -> nn.Module:
    prepare = _packed if example.device.type == "cpu" else _channels_last
    prepared = prepare(network, example, dtype)
    for name, module in list(prepared.named_modules()):
        if isinstance(module, nn.Softsign):
            _replace(prepared, name, _InPlaceSoftsign())
        elif isinstance(module, nn.SiLU):
            module.inplace = True
    return prepared


def _packed(network: nn.Module, example: Tensor, dtype: torch.dtype) -> nn.Module:
    """Return the network with every convolution and pooling in oneDNN."""
    prepared = copy.deepcopy(network).to(dtype)
    for name, shape in _input_shapes(network, example).items():
        module = prepared.get_submodule(name)
        if isinstance(module, nn.AvgPool3d):
            module = _pooling_convolution(shape[1], module).to(dtype)
        if isinstance(module, nn.Conv3d):
            _replace(prepared, name, _PackedConvolution(module, shape))
    return prepared


def _channels_last(network: nn.Module, _: Tensor, dtype: torch.dtype) -> nn.Module:
    """Return the network with the channels of every weight together in memory."""
    prepared = copy.deepcopy(network).to(dtype)
    for module in prepared.modules():
        if isinstance(module, nn.Conv3d):
            weight = module.weight.detach().contiguous(memory_format=torch.channels_last_3d)
            module.weight = nn.Parameter(weight, requires_grad=False)
    return prepared


class _PackedConvolution(nn.Module):
    """A convolution whose weights lie as oneDNN wants them for one shape of input."""

    def __init__(self, convolution: nn.Conv3d, shape: Sequence[int]) -> None:
        super().__init__()
        self._bias = convolution.bias
        self._stride, self._padding = list(convolution.stride), [int(p) for p in convolution.padding]
        self._dilation, self._groups = list(convolution.dilation), convolution.groups
        self._weight: Tensor = torch.ops.aten.mkldnn_reorder_conv3d_weight(
            convolution.weight.detach().to_mkldnn(),
            self._padding,
            self._stride,
            self._dilation,
            self._groups,
            list(shape),
        )

    def forward(self, inputs: Tensor) -> Tensor:
        output: Tensor = torch.ops.mkldnn._convolution_pointwise(
            inputs,
            self._weight,
            self._bias,
            self._padding,
            self._stride,
            self._dilation,
            self._groups,
            "none",
            [],
            "",
        )
        return output


class _InPlaceSoftsign(nn.Module):
    """x / (1 + |x|), written over its input: a convolution's output, which nothing else reads."""

    def forward(self, inputs: Tensor) -> Tensor:
        return inputs.div_(inputs.abs().add_(1.0))


def _pooling_convolution(channels: int, pool: nn.AvgPool3d) -> nn.Conv3d:
    """Return the convolution that averages as `pool` does, which torch lacks for half precision on a CPU."""
    size = pool.kernel_size
    convolution = nn.Conv3d(channels, channels, size, stride=size, groups=channels, bias=False)
    nn.init.constant_(convolution.weight, 1.0 / convolution.weight[0].numel())
    return convolution.requires_grad_(False)


def _input_shapes(network: nn.Module, example: Tensor) -> dict[str, tuple[int, ...]]:
    """Return the shape of what every convolution and pooling reads, by the module's name."""
    shapes: dict[str, tuple[int, ...]] = {}

    def note(name: str) -> Callable[[nn.Module, tuple[Tensor, ...]], None]:
        def hook(_: nn.Module, inputs: tuple[Tensor, ...]) -> None:
            shapes[name] = tuple(inputs[0].shape)

        return hook

    handles = [
        module.register_forward_pre_hook(note(name))
        for name, module in network.named_modules()
        if isinstance(module, nn.Conv3d | nn.AvgPool3d)
    ]
    try:
        network(example)
    finally:
        for handle in handles:
            handle.remove()
    return shapes


def _replace(network: nn.Module, name: str, module: nn.Module) -> None:
    parent, _, own = name.rpartition(".")
    setattr(network.get_submodule(parent), own, module)
