import dataclasses

import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.training_config import get_config
from softtissue_training.simulation.archive import record_name, write_record
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.reserved_seeds import FIRST_RESERVED_SEED

TINY = get_config("tiny")


def test_voxelising_in_processes_gives_the_same_samples(data_folder):
    here, there = SimulationSet(data_folder, TINY), SimulationSet(data_folder, TINY, workers=2)
    here.rescan()
    there.rescan()
    assert (len(here.training), len(here.held_out)) == (4, 2)
    assert here.digest() == there.digest()
    for ours, theirs in zip(here.training + here.held_out, there.training + there.held_out, strict=True):
        torch.testing.assert_close(ours.target, theirs.target, rtol=0, atol=0)
    before = here.training[0]
    here.rescan()
    assert here.training[0] is before
    assert len(here.training) == 4


def test_all_load_cases_of_an_organ_are_on_the_same_side(records, tmp_path):
    for number, record in enumerate(records[:5]):
        sample = record.simulations[0]
        again = dataclasses.replace(sample, displacement=2.0 * sample.displacement, case=1)
        both = dataclasses.replace(record, simulations=(sample, again))
        write_record(tmp_path, record_name(number), format_record(both))
    data = SimulationSet(tmp_path, TINY)
    data.rescan()
    assert (data.records, len(data.training), len(data.held_out)) == (5, 6, 4)
    sides = [
        {sample.signed_distance.numpy().tobytes() for sample in side}
        for side in (data.training, data.held_out)
    ]
    assert (len(sides[0]), len(sides[1])) == (3, 2)
    assert not sides[0] & sides[1]


def test_records_of_the_benchmark_are_refused(records, tmp_path):
    for number, record in enumerate(records[:2]):
        seed = (FIRST_RESERVED_SEED if number else FIRST_RESERVED_SEED - 1, number)
        moved = tuple(dataclasses.replace(sample, seed=seed) for sample in record.simulations)
        content = format_record(dataclasses.replace(record, simulations=moved))
        write_record(tmp_path, record_name(number), content)
    with pytest.raises(
        InvalidInputError, match="the benchmark's, which nothing may be trained on; got 1000000"
    ):
        SimulationSet(tmp_path, TINY).rescan()
