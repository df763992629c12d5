import logging

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
    return cached_arrays(what, digest, version, parameters, compute)


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
