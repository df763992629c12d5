"""What is written is read as it was, and nothing that would be pickled is written."""

import numpy as np
import pytest

from softtissue_estimator.support.arrays import save_arrays


def test_file_holds_the_arrays_alone(tmp_path):
    arrays = {
        "points": np.arange(6.0).reshape(2, 3),
        "reason": np.array("no organ"),
        "empty": np.empty(0, np.int32),
    }
    save_arrays(tmp_path / "arrays.npz", arrays)
    with np.load(tmp_path / "arrays.npz", allow_pickle=False) as stored:
        read = dict(stored)
    assert read.keys() == arrays.keys()
    assert {name: array.tolist() for name, array in read.items()} == {
        name: array.tolist() for name, array in arrays.items()
    }


def test_python_objects_are_refused(tmp_path):
    with pytest.raises(ValueError, match="got Python objects in names"):
        save_arrays(tmp_path / "arrays.npz", {"names": np.array([{}], dtype=object)})
    assert not (tmp_path / "arrays.npz").exists()
