from pathlib import Path

import numpy as np
import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.network import UNet, initialise
from softtissue_estimator.estimators.paper.network_spec import rigid_spec
from softtissue_training.learning import precision
from softtissue_training.learning.dataset import draw_visible, prepare
from softtissue_training.learning.loss import multi_resolution_loss
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.voxels import voxelise

SPEC = get_config("tiny").spec
CPU = torch.device("cpu")


def test_bfloat16_gradients_agree_with_float32(samples):
    # Wide enough, and coarse enough at the bottom, for the garbage that `restrict_autocast` avoids.
    prepared = prepare(samples[0], SPEC)
    visible = draw_visible(prepared, np.random.default_rng(0), (0.5, 0.5))
    inputs, target, mask = voxelise(prepared, *visible, SPEC, CPU)
    network = UNet(rigid_spec(SPEC.spacing).architecture)
    initialise(network, inputs, generator=torch.Generator().manual_seed(0))
    precision.restrict_autocast(network, CPU)

    def gradients(enabled):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            outputs = network.forward_all(inputs)
        assert all(output.dtype == torch.float32 for output in outputs)
        return torch.autograd.grad(multi_resolution_loss(outputs, target, mask), list(network.parameters()))

    exact = gradients(False)
    for _ in range(5):
        for rough, fine in zip(gradients(True), exact, strict=True):
            assert float((rough - fine).norm()) < 0.15 * float(fine.norm()) + 1e-6


@pytest.mark.parametrize("able", [True, False])
def test_precision_follows_the_device_and_the_wish(monkeypatch, able):
    monkeypatch.setattr(precision, "has_bfloat16", lambda device: able)
    assert precision.choose_bfloat16("auto", CPU) is able
    assert precision.choose_bfloat16("float32", CPU) is False
    if able:
        assert precision.choose_bfloat16("bfloat16", CPU)
    else:
        with pytest.raises(InvalidInputError, match="AVX-512 BF16 or AMX, got cpu without"):
            precision.choose_bfloat16("bfloat16", CPU)
    with pytest.raises(InvalidInputError, match="one of auto, float32, bfloat16, got 'half'"):
        precision.choose_bfloat16("half", CPU)


def test_the_processor_is_asked_for_its_instructions():
    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists():
        pytest.skip("no /proc/cpuinfo on this system")
    flags = cpuinfo.read_text().split()
    assert precision.has_bfloat16(CPU) == bool({"avx512_bf16", "amx_bf16"} & set(flags))
