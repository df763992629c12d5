"""Objects come out of a handed over file as they went in, and share nothing with it."""

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.handover import read_objects, write_objects

CPU = torch.device("cpu")


def round_trip(path, objects):
    write_objects(path, objects)
    return read_objects(path, CPU)


def test_arrays_tensors_and_what_holds_them(tmp_path):
    matrix = csr_array(np.diag([1.0, 0.0, 3.0]))
    tensor = torch.arange(12.0).reshape(3, 4)
    given = {"matrix": matrix, "turned": tensor.T, "whole": tensor, "empty": np.empty((0, 3)), "text": "ü"}
    got = round_trip(tmp_path / "file", given)
    assert (got["matrix"] != matrix).nnz == 0
    assert torch.equal(got["turned"], tensor.T) and torch.equal(got["whole"], tensor)
    assert got["empty"].shape == (0, 3) and got["text"] == "ü"


def test_what_was_one_object_stays_one(tmp_path):
    array = np.arange(1000.0)
    first, second = round_trip(tmp_path / "file", (array, [array]))
    assert first is second[0]
    assert (tmp_path / "file").stat().st_size < 1.5 * array.nbytes


def test_result_can_be_written_to_when_the_file_is_gone(tmp_path):
    array, tensor = round_trip(tmp_path / "file", (np.zeros(3), torch.zeros(3)))
    (tmp_path / "file").unlink()
    array[:] = 1.0
    tensor += 2.0
    assert array.sum() == 3.0 and float(tensor.sum()) == 6.0


def test_tensors_and_devices_are_those_of_the_reader(tmp_path):
    write_objects(tmp_path / "file", (torch.zeros(2), torch.device("cpu")))
    tensor, device = read_objects(tmp_path / "file", torch.device("meta"))
    assert tensor.device.type == device.type == "meta"


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_file_that_is_cut_off_is_a_sentence(tmp_path, share):
    path = tmp_path / "file"
    write_objects(path, np.zeros(1000))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InvalidInputError, match="expected .* numbers, got"):
        read_objects(path, CPU)
