import dataclasses

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.archive import (
    content_hash,
    digest,
    format_record,
    list_records,
    pack,
    parse_record,
    read_records,
    record_name,
    write_record,
)
from softtissue_training.sample import simulate

from .conftest import COARSE


def _same(ours, theirs):
    for field in dataclasses.fields(ours):
        mine, other = getattr(ours, field.name), getattr(theirs, field.name)
        if isinstance(mine, np.ndarray):
            np.testing.assert_array_equal(mine, other)
            assert mine.dtype == other.dtype
        else:
            assert mine == other


def test_record_keeps_everything(tmp_path):
    recipe = dataclasses.replace(COARSE, load_cases=2, gravity=(0.01, 0.02), poisson_ratio=(0.3, 0.4))
    record = simulate(3, 2, recipe)
    write_record(tmp_path, record_name(2), format_record(record))
    assert [file.name for file in tmp_path.iterdir()] == ["organ_000002.npz"]
    restored = parse_record((tmp_path / "organ_000002.npz").read_bytes(), "it")
    assert (restored.recipe, restored.rejected, restored.versions, restored.seed) == (
        recipe,
        record.rejected,
        record.versions,
        (3, 2),
    )
    assert len(restored.simulations) == 2
    for ours, theirs in zip(record.simulations, restored.simulations, strict=True):
        _same(ours, theirs)


def test_packed_file_holds_the_same_records(data_folder, tmp_path):
    packed = tmp_path / "sims.pack"
    assert pack(data_folder, packed) == 6
    names = list_records(packed)
    assert names == list_records(data_folder)
    assert list(read_records(packed, names)) == list(read_records(data_folder, names))


def test_a_cut_record_is_refused(records):
    content = format_record(records[0])
    with pytest.raises(InvalidInputError, match="half must be a complete simulation record"):
        parse_record(content[: len(content) // 2], "half")


def test_missing_and_foreign_data_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="does not exist"):
        list_records(tmp_path / "nothing")
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(InvalidInputError, match="softtissue-train pack"):
        list_records(tmp_path / "text")
    with pytest.raises(InvalidInputError, match="got none"):
        pack(tmp_path, tmp_path / "packed")


def test_content_hash_sees_every_array_and_the_recipe_but_not_versions(records):
    record = records[0]
    before = content_hash(format_record(record), "it")
    assert content_hash(format_record(dataclasses.replace(record, versions={"numpy": "0"})), "it") == before
    sample = record.simulations[0]
    for name in ("vertices", "tets", "faces", "attached", "force", "displacement", "pressure", "gravity"):
        changed = np.array(getattr(sample, name))
        # The last attached vertex is dropped; elsewhere a number changes by the least amount.
        changed = changed[:-1] if name == "attached" else changed
        if name != "attached":
            first = (0,) * changed.ndim
            step = 1 if changed.dtype.kind == "i" else np.spacing(changed[first])
            changed[first] += step
        other = dataclasses.replace(sample, **{name: changed})
        content = format_record(dataclasses.replace(record, simulations=(other,)))
        assert content_hash(content, "it") != before, name
    recipe = dataclasses.replace(record.recipe, force_n=(0.0, 0.5))
    assert content_hash(format_record(dataclasses.replace(record, recipe=recipe)), "it") != before


def test_digest_depends_on_content_and_not_on_order():
    assert digest({"a": "1", "b": "2"}) == digest({"b": "2", "a": "1"})
    assert digest({"a": "1", "b": "2"}) != digest({"a": "1", "b": "3"})
