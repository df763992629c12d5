import io
import logging
import os
import pickle
import time
import zipfile

import numpy as np
import pytest

from softtissue_estimator.support.cache import cache_folder, cached_arrays


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


class Counter:
    """Computes, and counts how often."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"values": np.arange(6.0).reshape(2, 3) * self.calls, "flag": np.array([True])}


def ask(compute, what="thing", digest="abc", version=1, **parameters):
    return cached_arrays(what, digest, version, parameters, compute, fits)


def fits(arrays):
    return arrays.keys() == {"values", "flag"} and arrays["values"].shape == (2, 3)


def test_second_time_is_read_and_equal():
    compute = Counter()
    first, second = ask(compute, edge=0.01), ask(compute, edge=0.01)
    assert compute.calls == 1
    assert second.keys() == first.keys()
    np.testing.assert_array_equal(second["values"], first["values"])
    assert second["flag"].dtype == np.bool_


@pytest.mark.parametrize("change", [{"what": "other"}, {"digest": "abd"}, {"version": 2}, {"edge": 0.02}])
def test_whatever_the_result_depends_on_makes_another(change):
    compute = Counter()
    ask(compute, edge=0.01)
    ask(compute, **{"edge": 0.01, **change})
    assert compute.calls == 2


@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda _: b"", lambda data: b"x" * len(data)]
)
def test_damaged_file_is_computed_again_and_mended(damage, caplog):
    compute = Counter()
    ask(compute)
    (file,) = cache_folder().glob("*.npz")
    file.write_bytes(damage(file.read_bytes()))
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(ask(compute)["values"], 2.0 * np.arange(6.0).reshape(2, 3))
    assert "cannot be read" in caplog.text
    ask(compute)
    assert compute.calls == 2


def resaved(**arrays):
    """Whole file with other arrays beside the key of the file that it replaces."""

    def damage(data):
        with np.load(io.BytesIO(data)) as stored:
            content = dict(stored) | arrays
        file = io.BytesIO()
        np.savez(file, **{name: array for name, array in content.items() if array is not None})
        return file.getvalue()

    return damage


def flags(data):
    """Every member says that it is encrypted."""
    changed = bytearray(data)
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(mark)
        while at >= 0:
            changed[at + place] |= 1
            at = data.find(mark, at + 1)
    return bytes(changed)


def method(data):
    """Every member says that it is compressed in a way that nobody knows."""
    changed = bytearray(data)
    for mark, place in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = data.find(mark)
        while at >= 0:
            changed[at + place] = 77
            at = data.find(mark, at + 1)
    return bytes(changed)


def bomb(data):
    """A small file whose arrays are large."""
    with np.load(io.BytesIO(data)) as stored:
        content = dict(stored) | {"values": np.zeros((2, 3, 10**6))}
    file = io.BytesIO()
    np.savez_compressed(file, **content)
    return file.getvalue()


def header(old, new):
    """The header of an array changed in place, with the sums of the archive made right again."""

    def damage(data):
        file = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(file, "w") as after:
            for name in before.namelist():
                after.writestr(name, before.read(name).replace(old, new))
        return file.getvalue()

    return damage


DAMAGE = {
    "encrypted": flags,
    "unknown compression": method,
    "bomb": bomb,
    "absurd shape": header(b"(2, 3), }", b"(2000000000, 3000000), }"),
    "no header": header(b"{'descr': '<f8'", b"[[[[[[[[[[[[[[["),
    "deep header": header(b"{'descr': '<f8'", b"{'descr': ((((("),
    "objects": header(b"'<f8'", b"'|O8'"),
    "an array alone": lambda _: npy(np.arange(3.0)),
    "pickled": lambda _: pickle.dumps({"values": 1}),
    "array missing": resaved(flag=None),
    "array too many": resaved(more=np.zeros(3)),
    "another shape": resaved(values=np.zeros((3, 2))),
    "key missing": resaved(cache_key=None),
}


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize("name", DAMAGE)
def test_whatever_is_wrong_with_a_file_it_is_computed_again(name):
    compute = Counter()
    ask(compute)
    (file,) = cache_folder().glob("*.npz")
    file.write_bytes(DAMAGE[name](file.read_bytes()))
    np.testing.assert_array_equal(ask(compute)["values"], 2.0 * np.arange(6.0).reshape(2, 3))
    ask(compute)
    assert compute.calls == 2


def test_every_byte_of_a_file_may_be_wrong():
    compute = Counter()
    ask(compute)
    (file,) = cache_folder().glob("*.npz")
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole)
        for place in rng.integers(len(whole), size=rng.integers(1, 4)):
            data[place] = rng.integers(256)
        file.write_bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.2 else data)
        compute.calls = 0
        np.testing.assert_array_equal(ask(compute)["values"], np.arange(6.0).reshape(2, 3))
        file.write_bytes(whole)


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to nowhere", "link to a device"])
def test_what_is_no_file_is_computed(kind):
    compute = Counter()
    ask(compute)
    (file,) = cache_folder().glob("*.npz")
    file.unlink()
    if kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/nowhere/else" if kind == "link to nowhere" else "/dev/zero")
    ask(compute)
    assert compute.calls == 2


def test_without_a_home_nothing_is_kept(monkeypatch, tmp_path):
    def nobody(_path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setattr("pathlib.Path.expanduser", nobody)
    monkeypatch.chdir(tmp_path)
    compute = Counter()
    ask(compute)
    ask(compute)
    assert compute.calls == 2
    assert list(tmp_path.iterdir()) == []


def test_half_files_of_programs_that_were_killed_go():
    cache_folder().mkdir(parents=True)
    old, young = cache_folder() / "old.part", cache_folder() / "young.part"
    for file in (old, young):
        file.write_text("half")
    os.utime(old, (time.time() - 4000.0,) * 2)
    ask(Counter())
    assert young.exists() and not old.exists()


def test_folder_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compute = Counter()
    with caplog.at_level(logging.WARNING):
        ask(compute)
        ask(compute)
    assert compute.calls == 2
    assert "cannot be kept" in caplog.text


def test_failed_computation_leaves_nothing():
    def fail():
        raise RuntimeError("no result")

    with pytest.raises(RuntimeError, match="no result"):
        ask(fail)
    assert not cache_folder().exists() or not list(cache_folder().iterdir())


def test_relative_cache_home_is_ignored(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "softtissue_estimator"


def test_of_two_that_compute_at_once_both_take_the_first_result(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def result(value):
        return {"value": np.array([value])}

    def slower():
        cached_arrays("thing", "digest", 1, {}, lambda: result(1.0))  # another process, meanwhile
        return result(2.0)

    for compute in (slower, slower):
        assert cached_arrays("thing", "digest", 1, {}, compute)["value"].tolist() == [1.0]
