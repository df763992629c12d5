"""Replaying recorded work: answers that no later call changes, and no graph where none can be had."""

import pytest
import torch

from estimator.recorded_on_cpu import recorded_on_cpu
from softtissue_estimator.inference.captured_call import CapturedCall


def twice_and_sum(inputs):
    return 2.0 * inputs, inputs.sum()


def test_each_answer_is_of_its_own_input_and_stays():
    call = CapturedCall(twice_and_sum, torch.zeros(3), pytest.fail, record=recorded_on_cpu)
    assert call.captured
    inputs = [torch.tensor([1.0, 2.0, 3.0]), torch.tensor([-1.0, 0.0, 5.0]), torch.tensor([1.0, 2.0, 3.0])]
    answers = [call(each) for each in inputs]
    for given, (twice, total) in zip(inputs, answers, strict=True):
        torch.testing.assert_close(twice, 2.0 * given, rtol=0, atol=0)
        assert float(total) == float(given.sum())
    assert torch.equal(inputs[0], torch.tensor([1.0, 2.0, 3.0]))


def test_on_a_cpu_the_function_is_called():
    call = CapturedCall(twice_and_sum, torch.zeros(3), pytest.fail)
    assert not call.captured
    assert torch.equal(call(torch.ones(3))[0], torch.full((3,), 2.0))


def test_what_cannot_be_recorded_is_called_and_said_once():
    said = []

    def refuse(work):
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    call = CapturedCall(twice_and_sum, torch.zeros(3), said.append, record=refuse)
    assert torch.equal(call(torch.ones(3))[0], torch.full((3,), 2.0))
    assert not call.captured
    assert said == [
        "network: no CUDA graph on cpu (operation not permitted when stream is capturing); its kernels are started "
        "one by one"
    ]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_graph_on_a_gpu_gives_the_same_answers():
    call = CapturedCall(twice_and_sum, torch.zeros(3, device="cuda"), pytest.fail)
    assert call.captured
    first, second = call(torch.ones(3, device="cuda")), call(torch.full((3,), 4.0, device="cuda"))
    assert float(first[1]) == 3.0 and float(second[1]) == 12.0
