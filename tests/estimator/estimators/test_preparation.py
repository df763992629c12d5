"""An organ prepared in another process answers as one prepared here; whatever goes wrong there is told here."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from estimator.organ_folders import describe
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, MeshError, OrganError
from softtissue_estimator.estimators import preparation
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.estimators.preparation import (
    Prepared,
    Request,
    WorkerError,
    prepare,
    prepare_elsewhere,
)
from softtissue_estimator.observation.observation import Observation

CONFIG = EstimatorConfig(device="cpu")


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    """Folder of temporary files, in which nothing is left."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture
def request_(folder):
    return Request(describe(folder), (folder,), CONFIG)


def answer(prepared: Prepared, config: EstimatorConfig):
    estimator = create_estimator(config)
    estimator.take_over(prepared.organ, prepared.computed)
    vertices = prepared.organ.surface.vertices
    moved = np.zeros_like(vertices)
    moved[:, 2] = -0.01 * ((vertices[:, 0] - 0.09) / 0.18) ** 2
    return estimator.estimate(Observation(vertices, moved, np.full(len(vertices), 1e-3)))


@pytest.mark.parametrize("name", ["elastic", "paper"])
def test_answers_are_those_of_an_organ_prepared_here(request_, name):
    config = dataclasses.replace(CONFIG, estimator=name)
    request_ = dataclasses.replace(request_, config=config)
    here, there = prepare(request_, lambda _: None), prepare_elsewhere(request_, lambda _: None)
    assert there.organ.digest == here.organ.digest
    first, second = answer(here, config), answer(there, config)
    # The other process has one thread, and so another order of sums.
    np.testing.assert_allclose(second.displacement, first.displacement, rtol=0, atol=2e-6)
    if name != "paper":  # which says nothing about its error
        np.testing.assert_allclose(second.sigma, first.sigma, rtol=0, atol=1e-7)
    assert np.linalg.norm(first.displacement, axis=1).max() > 0.005


def test_what_is_slow_is_said_while_it_goes_on(folder, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    said = []
    prepare_elsewhere(Request(describe(folder, attached=None), (folder,), CONFIG), said.append)
    assert any(sentence.startswith("filling the organ with tetrahedra") for sentence in said)
    assert any(sentence.startswith("warning: ") and "attached" in sentence for sentence in said)
    assert list((folder / "cache").rglob("tetrahedra-*.npz")), "kept for the next time"


def test_what_is_wrong_with_an_organ_is_the_same_error_as_here(folder):
    (folder / "tumour.ply").write_text("no mesh")
    request_ = Request(describe(folder), (folder,), CONFIG)
    with pytest.raises(MeshError, match="tumour.ply") as here:
        prepare(request_, lambda _: None)
    with pytest.raises(MeshError) as there:
        prepare_elsewhere(request_, lambda _: None)
    assert str(there.value) == str(here.value)


def test_estimator_that_only_this_process_knows_computes_here(request_):
    config = dataclasses.replace(CONFIG, estimator="mine")
    assert prepare_elsewhere(dataclasses.replace(request_, config=config), lambda _: None).computed is None


def program(tmp_path: Path, body: str) -> Path:
    path = tmp_path / "program.py"
    path.write_text(f"import os, sys, time, pathlib\n{body}\n")
    return path


@pytest.mark.parametrize(
    ("body", "error", "said"),
    [
        ("raise KeyError('unexpected')", WorkerError, "KeyError: 'unexpected'"),
        ("os.kill(os.getpid(), 11)", OrganError, "got signal 11"),
        ("time.sleep(60)", OrganError, "expected one that is prepared within 1 s"),
        ("pathlib.Path(sys.argv[2]).write_bytes(bytes(5))", InvalidInputError, "expected .* got"),
        ("pathlib.Path('more').mkdir(); raise ValueError", WorkerError, "ValueError"),
    ],
)
def test_process_that_ends_badly_is_an_error_here(request_, tmp_path, monkeypatch, body, error, said):
    monkeypatch.setattr(preparation, "_WORKER", program(tmp_path, body))
    monkeypatch.setattr(preparation, "_TIMEOUT_S", 1.0 if "sleep" in body else 60.0)
    with pytest.raises(error, match=said):
        prepare_elsewhere(request_, lambda _: None)
