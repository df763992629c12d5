"""Small simulations that the tests of the training package share."""

import dataclasses

import numpy as np
import pytest

from softtissue_training.evaluation.streams.plan import organ_name
from softtissue_training.evaluation.streams.stream import make_stream
from softtissue_training.simulation.archive import record_name, write_record
from softtissue_training.simulation.moving_organ import simulate_motion
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.sample import Record, Sample
from training.coarse import COARSE_MOTION, COARSE_STREAM, LINEAR, coarse_records


@pytest.fixture(scope="session")
def records() -> list[Record]:
    """Six organs with coarse elements, one load case each."""
    return list(coarse_records())


@pytest.fixture(scope="session")
def samples(records) -> list[Sample]:
    """The simulations of `records`."""
    return [record.simulations[0] for record in records]


@pytest.fixture(scope="session")
def linear_sample(samples) -> Sample:
    """A sample whose displacement is replaced by a linear function of the position (`LINEAR`)."""
    vertices = samples[0].vertices
    return dataclasses.replace(samples[0], displacement=(vertices @ LINEAR.T).astype(np.float32))


@pytest.fixture(scope="session")
def data_folder(records, tmp_path_factory):
    """Folder with `records`."""
    folder = tmp_path_factory.mktemp("sims")
    for number, record in enumerate(records):
        write_record(folder, record_name(number), format_record(record))
    return folder


@pytest.fixture(scope="session")
def coarse_breathing_liver(tmp_path_factory):
    """A breathing liver of few elements, and the folder of its case."""
    from softtissue_training.experiments.breathing_liver.build import build_case, coarse
    from softtissue_training.experiments.breathing_liver.spec import BreathingSpec

    folder = tmp_path_factory.mktemp("breathing_liver")
    return build_case(coarse(BreathingSpec()), folder), folder


@pytest.fixture(scope="session")
def coarse_motions():
    """Motions of two organs with coarse elements."""
    return [simulate_motion(5, number, COARSE_MOTION) for number in range(2)]


@pytest.fixture(scope="session")
def coarse_streams(coarse_motions):
    """Observations of `coarse_motions`, few frames of few points."""
    return [
        make_stream(motion, organ_name(number), (5, number), COARSE_STREAM)
        for number, motion in enumerate(coarse_motions)
    ]
