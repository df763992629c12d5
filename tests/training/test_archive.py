import dataclasses

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.archive import digest, list_records, pack, parse_sample, read_records, write_sample


def test_record_keeps_everything(samples, tmp_path):
    path = write_sample(tmp_path, samples[2], {"shape": 3})
    restored, rejected = parse_sample(path.read_bytes(), str(path))
    assert rejected == {"shape": 3}
    for field in dataclasses.fields(samples[2]):
        ours, theirs = getattr(samples[2], field.name), getattr(restored, field.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs)
            assert ours.dtype == theirs.dtype
        else:
            assert ours == theirs
    assert [file.name for file in tmp_path.iterdir()] == ["sample_000002.npz"]


def test_packed_file_holds_the_same_records(data_folder, tmp_path):
    packed = tmp_path / "sims.pack"
    assert pack(data_folder, packed) == 6
    names = list_records(packed)
    assert names == list_records(data_folder)
    assert list(read_records(packed, names)) == list(read_records(data_folder, names))


def test_a_cut_record_is_refused(samples, tmp_path):
    path = write_sample(tmp_path, samples[0], {})
    content = path.read_bytes()
    with pytest.raises(InvalidInputError, match="complete simulation record"):
        parse_sample(content[: len(content) // 2], "half")


def test_missing_and_foreign_data_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="does not exist"):
        list_records(tmp_path / "nothing")
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(InvalidInputError, match="softtissue-train pack"):
        list_records(tmp_path / "text")
    with pytest.raises(InvalidInputError, match="got none"):
        pack(tmp_path, tmp_path / "packed")


def test_digest_depends_on_content_and_not_on_order():
    assert digest({"a": "1", "b": "2"}) == digest({"b": "2", "a": "1"})
    assert digest({"a": "1", "b": "2"}) != digest({"a": "1", "b": "3"})
