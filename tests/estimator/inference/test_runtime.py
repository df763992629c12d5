"""Networks prepared for one shape of input: the same numbers as the plain modules, as far as their format goes."""

import copy
import time

import numpy as np
import pytest
import torch

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_input import (
    cached_channels,
    field_of,
    input_of,
    organ_grid,
)
from softtissue_estimator.inference import runtime as network_runtime
from softtissue_estimator.inference.device import one_thread
from softtissue_estimator.inference.precision import choose_precision, computes_in
from softtissue_estimator.inference.runtime import NetworkRuntime
from softtissue_estimator.observation.bending_organ import BendingOrgan
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_checkpoint, bundled_organ

CPU = torch.device("cpu")


def paper_network():
    torch.manual_seed(0)
    return UNet(UNetArchitecture(widths=(8, 8, 16, 16))).eval().requires_grad_(False)


class NetworkOfAnother(torch.nn.Module):
    """What a registered estimator may run: normalised groups, pooling, upsampling, a skip connection."""

    architecture = UNetArchitecture(in_channels=10)

    def __init__(self):
        super().__init__()
        self.fine, self.pool = self.level(10, 8), torch.nn.AvgPool3d(2)
        self.coarse, self.decoder = self.level(8, 16), self.level(24, 8)
        self.head = torch.nn.Conv3d(8, 4, kernel_size=1)

    @staticmethod
    def level(incoming, width):
        convolution = torch.nn.Conv3d(incoming, width, kernel_size=3, padding=1, bias=False)
        return torch.nn.Sequential(convolution, torch.nn.GroupNorm(2, width), torch.nn.SiLU())

    def forward(self, inputs):
        fine = self.fine(inputs)
        coarse = torch.nn.functional.interpolate(
            self.coarse(self.pool(fine)), scale_factor=2, mode="trilinear", align_corners=False
        )
        return self.head(self.decoder(torch.cat([coarse, fine], dim=1)))


def network_of_another():
    torch.manual_seed(0)
    return NetworkOfAnother().eval().requires_grad_(False)


def inputs_of(network, seed):
    shape = (1, network.architecture.in_channels, 16, 8, 24)
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def needs(name, device=CPU):
    if not computes_in(name, device):
        pytest.skip(f"this processor does not compute in {name}")


@pytest.mark.parametrize("make", [paper_network, network_of_another])
@pytest.mark.parametrize(("name", "share"), [("float32", 1e-5), ("float16", 5e-3), ("bfloat16", 4e-2)])
def test_prepared_is_the_network_itself(make, name, share):
    needs(name)
    network = make()
    before = copy.deepcopy(network.state_dict())
    inputs = [inputs_of(network, seed) for seed in (1, 2)]
    runtime = NetworkRuntime(network, inputs[0].shape, CPU, choose_precision(name, CPU), pytest.fail)
    assert runtime.description == name
    with torch.inference_mode():
        answers = [runtime(each) for each in inputs]
        for given, answer in zip(inputs, answers, strict=True):
            expected = network(given)
            assert answer.dtype == torch.float32 and answer.shape == expected.shape
            largest = float(expected.abs().max())
            torch.testing.assert_close(answer, expected, rtol=0, atol=share * largest)
        assert float((answers[0] - answers[1]).abs().max()) > 0.1 * largest
    for key, weight in network.state_dict().items():
        assert torch.equal(weight, before[key])


@pytest.mark.parametrize("make", [paper_network, network_of_another])
def test_what_a_gpu_gets_is_the_network_itself(make):
    """The same preparation, without the GPU."""
    network = make()
    inputs = inputs_of(network, 1)
    with torch.inference_mode():
        prepared = network_runtime._channels_last(network, inputs, torch.float32)
        found = prepared(inputs.to(memory_format=torch.channels_last_3d))
        torch.testing.assert_close(found, network(inputs), rtol=1e-4, atol=1e-5)
    weights = [weight for weight in prepared.parameters() if weight.ndim == 5]
    assert all(weight.is_contiguous(memory_format=torch.channels_last_3d) for weight in weights)


def test_other_inputs_are_refused_as_by_the_network():
    network = paper_network()
    runtime = NetworkRuntime(network, (1, 5, 8, 8, 8), CPU, torch.float32, pytest.fail)
    with pytest.raises(InvalidInputError, match="multiples of 8"), torch.inference_mode():
        runtime(torch.zeros(1, 5, 8, 8, 12))


@pytest.mark.parametrize("failure", ["raises", "wrong", "not finite"])
def test_where_it_cannot_be_prepared_the_plain_network_answers(failure, monkeypatch):
    own = network_runtime._prepared

    def broken(network, example, dtype):
        if failure == "raises":
            raise RuntimeError("could not create a primitive\nand a trace")
        prepared = own(network, example, dtype)
        prepared.register_forward_hook(lambda _, __, out: out * (1.5 if failure == "wrong" else float("nan")))
        return prepared

    monkeypatch.setattr(network_runtime, "_prepared", broken)
    network, said = paper_network(), []
    inputs = inputs_of(network, 1)
    runtime = NetworkRuntime(network, inputs.shape, CPU, torch.float32, said.append)
    with torch.inference_mode():
        torch.testing.assert_close(runtime(inputs), network(inputs))
    reason = {
        "raises": "could not create a primitive",
        "wrong": "its outputs are off by 0.5 of the largest one",
    }
    assert len(said) == 1
    assert said[0].startswith(
        "network in float32 cannot be used on cpu (" + reason.get(failure, "its outputs")
    )
    assert "\n" not in said[0]


@pytest.fixture(scope="module")
def real():
    """The bundled weights, inputs of the bundled organ as it bends, and what the plain network answers inside it."""
    organ, checkpoint = load_organ(bundled_organ()), load_checkpoint(bundled_checkpoint())
    channels = cached_channels(organ, organ_grid(organ.surface, checkpoint.spec))
    inputs = []
    for seed, time_s in ((0, 0.5), (1, 1.5)):
        scene = BendingOrgan(organ, 1500, np.random.default_rng(seed))
        sigma = np.full(1500, 5e-4)
        observation, _ = make_observation(
            scene.points(time_s), scene.reference, sigma, organ, EstimatorConfig()
        )
        inputs.append(input_of(organ, channels, observation, checkpoint.spec))
    return checkpoint, channels, inputs


def largest_difference_mm(real, name, device):
    """Of the displacements and, if the network gives them, of the standard deviations."""
    checkpoint, channels, inputs = real
    dtype = choose_precision(name, device)
    runtime = NetworkRuntime(checkpoint.network, inputs[0].shape, device, dtype, pytest.fail)
    worst, moved = 0.0, 0.0

    def answer_mm(outputs):
        return 1e3 * field_of(outputs[0][:, channels.organ_mask].T, checkpoint.spec)

    with torch.inference_mode():
        for given in inputs:
            expected = answer_mm(checkpoint.network(given))
            apart = answer_mm(runtime(given.to(device)).cpu()) - expected
            worst = max(worst, float(apart[:, :3].norm(dim=1).max()), *apart[:, 3:].abs().flatten().tolist())
            moved = max(moved, float(expected[:, :3].norm(dim=1).max()))
    assert moved > 5.0
    return worst


@pytest.mark.parametrize(("name", "limit_mm"), [("float32", 1e-3), ("float16", 0.05), ("bfloat16", 0.05)])
def test_difference_that_the_format_makes_to_the_bundled_weights(real, name, limit_mm):
    needs(name)
    assert largest_difference_mm(real, name, CPU) < limit_mm


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("name", ["float32", "float16"])
def test_difference_on_a_gpu(real, name):
    assert largest_difference_mm(real, name, torch.device("cuda")) < 0.05


def test_a_format_without_instructions_is_refused(monkeypatch):
    name = "softtissue_estimator.inference.precision._cpu_has"
    monkeypatch.setattr(name, lambda instructions: instructions == "avx512_bf16")
    assert choose_precision("bfloat16", CPU) is torch.bfloat16
    with pytest.raises(InvalidInputError, match="parameter precision: .* got 'float16' on cpu"):
        choose_precision("float16", CPU)
    with pytest.raises(
        InvalidInputError, match="expected one of auto, float32, bfloat16, float16, got 'int8'"
    ):
        choose_precision("int8", CPU)


@pytest.mark.parametrize(
    ("instructions", "expected"),
    [
        ((), torch.float32),
        (("avx512_bf16", "avx512_fp16"), torch.float32),
        (("avx512_bf16", "avx512_fp16", "amx_tile"), torch.bfloat16),
        (("avx512_bf16", "avx512_fp16", "amx_tile", "amx_fp16"), torch.float16),
    ],
)
def test_auto_is_the_format_that_the_processor_multiplies_matrices_of(monkeypatch, instructions, expected):
    monkeypatch.setattr(
        "softtissue_estimator.inference.precision._cpu_has", lambda name: name in instructions
    )
    assert choose_precision("auto", CPU) is expected


@pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="torch without oneDNN")
def test_what_auto_takes_is_not_slower_than_float32(real):
    """Of two formats that take turns, whose shortest times other programs disturb least."""
    chosen = choose_precision("auto", CPU)
    if chosen is torch.float32:
        pytest.skip("this processor has no units for half precision")
    checkpoint, _, inputs = real
    runtimes = [
        NetworkRuntime(checkpoint.network, inputs[0].shape, CPU, dtype, pytest.fail)
        for dtype in (chosen, torch.float32)
    ]
    with torch.inference_mode(), one_thread():
        times = [[_seconds(runtime, inputs[0]) for runtime in runtimes] for _ in range(8)]
    fast, slow = np.min(times[1:], axis=0)
    assert fast < slow


def _seconds(runtime, given):
    began = time.perf_counter()
    runtime(given)
    return time.perf_counter() - began
