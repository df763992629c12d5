"""A network learns organs by heart (configuration `overfit`): data, target, loss and steps work together."""

import os

import pytest
import torch

from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.train import train
from softtissue_training.learning.training_config import get_config
from softtissue_training.simulation.archive import record_name, write_record
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.simulate import simulate


def _errors_mm(records, folder, steps, **changes):
    """Mean errors inside the organs after training: of the network, of no estimate and of a rigid fit."""
    data = folder / "sims"
    data.mkdir()
    for number, record in enumerate(records):
        write_record(data, record_name(number), format_record(record))
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        summary = train(data, folder / "run", get_config("overfit", **changes), Schedule(steps=steps))
    finally:
        torch.set_num_threads(before)
    assert summary.training_samples == len(records)
    return summary.validation_error_mm, summary.no_estimate_error_mm, summary.rigid_error_mm


def test_two_organs_are_learned_to_half_a_millimetre(records, tmp_path):
    error, nothing, rigid = _errors_mm(records[:2], tmp_path, 250, learning_rate=1e-2)
    assert error < 0.5
    assert min(nothing, rigid) > 1.0


@pytest.mark.skipif("SOFTTISSUE_SLOW_TESTS" not in os.environ, reason="minutes: set SOFTTISSUE_SLOW_TESTS=1")
@pytest.mark.timeout(1800)
def test_eight_organs_are_learned_to_less_than_0_3_mm(tmp_path):
    records = [simulate(3, number, Recipe(element_size_m=0.02)) for number in range(8)]
    error, nothing, rigid = _errors_mm(records, tmp_path, 1500)
    assert error < 0.3
    assert min(nothing, rigid) > 1.0
