"""Small simulations that the tests of the training package share."""

import dataclasses

import numpy as np
import pytest

from softtissue_training.archive import write_sample
from softtissue_training.sample import Sample, simulate

ELEMENT_SIZE_M = 0.02


@pytest.fixture(scope="session")
def _simulated():
    return [simulate(3, number, edge_length_m=ELEMENT_SIZE_M) for number in range(6)]


@pytest.fixture(scope="session")
def samples(_simulated) -> list[Sample]:
    """Six simulations with coarse elements."""
    return [sample for sample, _ in _simulated]


@pytest.fixture(scope="session")
def linear_sample(samples) -> Sample:
    """A sample whose displacement is replaced by a linear function of the position (`LINEAR`)."""
    vertices = samples[0].vertices
    return dataclasses.replace(samples[0], displacement=(vertices @ LINEAR.T).astype(np.float32))


LINEAR = np.array([[0.1, 0.2, -0.1], [0.05, -0.1, 0.3], [-0.2, 0.1, 0.15]])


@pytest.fixture(scope="session")
def data_folder(_simulated, tmp_path_factory):
    """Folder with the records of `samples`."""
    folder = tmp_path_factory.mktemp("sims")
    for sample, rejected in _simulated:
        write_sample(folder, sample, rejected)
    return folder
