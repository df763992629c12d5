"""The clock of stages, and the way of arrays to a device and back."""

import time

import numpy as np
import pytest
import torch

from softtissue_estimator.inference.device import StageClock, to_device, to_host

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]


@pytest.mark.parametrize("device", DEVICES)
def test_arrays_come_back_as_they_went(device):
    first, second = np.arange(12.0).reshape(3, 4), np.arange(5)
    there = to_device(first, torch.device(device)), to_device(second, torch.device(device))
    assert all(tensor.device.type == device for tensor in there)
    for array, tensor in zip((first, second), to_host(*there), strict=True):
        np.testing.assert_array_equal(tensor.numpy(), array)
        assert tensor.dtype == torch.from_numpy(array).dtype


def test_stages_on_a_cpu_take_the_time_between_laps():
    clock = StageClock(torch.device("cpu"))
    time.sleep(0.02)
    clock.lap("slow")
    clock.lap("fast")
    stages = clock.stages()
    assert list(stages) == ["slow", "fast"]
    assert stages["slow"] >= 0.02 > stages["fast"] >= 0.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_stage_on_a_gpu_is_charged_with_its_own_work():
    numbers = torch.randn(4096, 4096, device="cuda")
    torch.cuda.synchronize()
    clock = StageClock(numbers.device)
    for _ in range(50):
        numbers = (numbers @ numbers).clamp(-1.0, 1.0)
    clock.lap("products")
    clock.lap("nothing")
    stages = clock.stages()
    assert stages["products"] > 1e-3 > stages["nothing"]
