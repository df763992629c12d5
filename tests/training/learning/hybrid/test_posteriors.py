"""Posteriors of simulations, kept for training: the same as the estimator's own, added to after an interruption."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import softtissue_estimator
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.estimators.hybrid import estimator as hybrid_estimator
from softtissue_estimator.estimators.hybrid.checkpoint import save_hybrid_checkpoint
from softtissue_estimator.estimators.hybrid.network import HybridNetwork
from softtissue_estimator.organ.mesh import face_areas, vertex_areas
from softtissue_estimator.organ.organ import make_organ
from softtissue_training.cli import main
from softtissue_training.learning.hybrid import posteriors
from softtissue_training.learning.hybrid.config import get_hybrid_config
from softtissue_training.learning.hybrid.posterior_record import parse_posteriors
from softtissue_training.learning.hybrid.posteriors import MESH_CACHE, make_posteriors
from softtissue_training.learning.hybrid.sample import hybrid_sample
from softtissue_training.learning.hybrid.views import ViewRecipe, draw_attachment, draw_view
from softtissue_training.simulation.archive import record_name
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.sample import Record

SPEC = get_hybrid_config("hybrid-tiny").spec
RECIPE = ViewRecipe(views=2, misattached=0.0, sparse=0.0)


@pytest.fixture(scope="module")
def made(data_folder, tmp_path_factory):
    """Posteriors of the first organ, and the folder with its coarse mesh."""
    out, meshes = tmp_path_factory.mktemp("posteriors"), tmp_path_factory.mktemp("meshes")
    report = make_posteriors(data_folder, out, RECIPE, SPEC, count=1, meshes=meshes, show_progress=False)
    assert (report.organs, report.made, report.views, report.failures) == (1, 1, 2, {})
    return out, meshes


def record_in(out, number=0):
    return parse_posteriors((out / record_name(number)).read_bytes(), "here")


def test_stored_sample_is_what_the_estimator_sees_and_leaves(made, samples, tmp_path, monkeypatch):
    """Beside the same view, drawn again and answered by the estimator itself on the same coarse mesh."""
    out, meshes = made
    sample, case = samples[0], record_in(out).cases[0]
    shutil.copytree(meshes / "organ_000000", tmp_path / "cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    network = HybridNetwork(SPEC.architecture)
    torch.nn.init.zeros_(network.heads[0].weight)
    torch.nn.init.zeros_(network.heads[0].bias)
    save_hybrid_checkpoint(tmp_path / "zero.safetensors", network, SPEC, {})
    estimator = create_estimator(
        EstimatorConfig(estimator="hybrid", checkpoint=str(tmp_path / "zero.safetensors"), device="cpu")
    )
    organ = make_organ("organ", "organ", sample.surface, (), sample.attached_mask)
    estimator.load_organ(organ)
    inputs = []
    monkeypatch.setattr(
        hybrid_estimator.HybridEstimator,
        "_inputs",
        lambda self, elastic, prepared, own=hybrid_estimator.HybridEstimator._inputs: (
            inputs.append(own(self, elastic, prepared)) or inputs[-1]
        ),
    )
    rng = np.random.default_rng([RECIPE.seed, *sample.seed, 0])
    draw_attachment(sample.surface, sample.attached_mask, RECIPE, rng)
    points, truth = sample.vertices.astype(np.float64), sample.displacement.astype(np.float64)
    for number in range(2):
        view = draw_view(organ, truth[: sample.surface_count], RECIPE, rng)
        displacement, sigma = estimator.estimate(view.observation).displacement_at(points)
        stored = hybrid_sample(case, number, SPEC)
        np.testing.assert_allclose(stored.target.numpy(), truth - displacement, atol=1e-5)
        np.testing.assert_allclose(stored.sigma.numpy(), sigma, rtol=2e-3)
        # In units of 20 mm, 2 mm and one: micrometres. Where the posterior knows least, at single cells of the border,
        # the logarithm of its deviation is stored less exactly.
        off = (stored.inputs - inputs[number]).abs()
        assert (off < 5e-3).float().mean() > 0.999 and off.max() < 5e-2
        assert float(stored.inputs.std()) > 0.1
        assert stored.visible.numpy()[: sample.surface_count].tolist() == view.visible.tolist()
        assert not stored.visible.numpy()[sample.surface_count :].any()
        assert float(case.share[number]) == pytest.approx(view.share, abs=1e-6)


def test_only_what_is_missing_is_made(made, data_folder, monkeypatch):
    out, meshes = made
    first = (out / record_name(0)).read_bytes()
    (out / "organ_000001.npz.partial99").write_bytes(b"half")  # what a kill may leave
    asked = []
    own = posteriors._posteriors_of

    def counted(task, **options):
        asked.append(task[0])
        if len(asked) == 2:
            raise KeyboardInterrupt
        return own(task, **options)

    monkeypatch.setattr(posteriors, "_posteriors_of", counted)
    with pytest.raises(KeyboardInterrupt):
        make_posteriors(data_folder, out, RECIPE, SPEC, count=3, meshes=meshes, show_progress=False)
    assert asked == [record_name(1), record_name(2)]
    assert (out / record_name(0)).read_bytes() == first
    assert len(record_in(out, 1).cases) == 1 and not (out / record_name(2)).exists()
    assert [path.name[: len(MESH_CACHE)] for path in meshes.glob("*/*/*")] == 2 * [MESH_CACHE]


def test_folder_of_another_estimator_or_recipe_is_refused(made, data_folder, monkeypatch):
    out, _ = made
    with pytest.raises(InvalidInputError, match="got others .different: recipe.; delete the folder"):
        make_posteriors(data_folder, out, ViewRecipe(views=3), SPEC, count=1, show_progress=False)
    monkeypatch.setattr(posteriors, "elastic_code_hash", lambda: "changed")
    with pytest.raises(InvalidInputError, match="got others .different: code."):
        make_posteriors(data_folder, out, RECIPE, SPEC, count=1, show_progress=False)


def test_command_that_is_killed_goes_on(data_folder, tmp_path):
    out = tmp_path / "posteriors"
    arguments = ["posterior", "--data", str(data_folder), "--out", str(out), "--config", "hybrid-tiny"]
    arguments += ["--views", "1", "--count", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "softtissue_training", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end = time.monotonic() + 100.0
    try:
        while not (out / record_name(0)).exists() and not (out / record_name(1)).exists():
            assert process.poll() is None and time.monotonic() < end
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
    process.wait()
    kept = {path.name: path.read_bytes() for path in out.glob("organ_*.npz")}
    report = make_posteriors(data_folder, out, ViewRecipe(views=1), SPEC, count=2, show_progress=False)
    assert (report.organs, report.made) == (2, 2 - len(kept))
    for name, content in kept.items():
        assert (out / name).read_bytes() == content


def test_wrong_arguments_end_with_one_sentence(data_folder, tmp_path, capsys):
    for arguments, message in (
        (["--config", "paper"], "must be one of hybrid, hybrid-full, hybrid-tiny, got 'paper'"),
        (["--skip", "9"], "expected simulations after the first 9, got none"),
        (["--seed", "-1"], "expected whole numbers from 0, got -1"),
    ):
        assert main(["posterior", "--data", str(data_folder), "--out", str(tmp_path / "p"), *arguments]) == 2
        assert message in capsys.readouterr().err


def test_simulations_of_the_benchmark_are_refused(samples):
    reserved = dataclasses.replace(samples[0], seed=(1_000_000, 0))
    content = format_record(Record((reserved,), Recipe(), {}, {}))
    with pytest.raises(InvalidInputError, match="nothing may be trained on"):
        posteriors._posteriors_of(("organ_000000.npz", content), RECIPE, SPEC, {})


def test_views_are_as_the_recipe_says(samples):
    sample = samples[1]
    organ = make_organ("organ", "organ", sample.surface, (), sample.attached_mask)
    truth = sample.displacement[: sample.surface_count].astype(np.float64)
    rng = np.random.default_rng(0)
    views = [draw_view(organ, truth, ViewRecipe(sparse=0.3), rng) for _ in range(60)]
    areas = face_areas(sample.surface)
    shares = np.array([view.share for view in views])
    assert shares.min() < 0.06 and shares.max() > 0.55
    noisy = np.array([view.noise_m > 0.0 for view in views])
    assert 0.3 < noisy.mean() < 0.7 and max(view.noise_m for view in views) > 0.002
    few = np.array([len(view.observation.reference) <= 40 for view in views])
    assert 0.15 < few.mean() < 0.5
    for view in views:
        assert (view.observation.sigma == max(view.noise_m, 2e-4)).all()
        seen = view.visible[sample.surface.faces].all(axis=1)
        assert areas[seen].sum() / areas.sum() == pytest.approx(view.share, abs=0.15)
    clean = next(view for view in views if view.noise_m == 0.0 and len(view.observation.reference) > 40)
    distance = np.linalg.norm(organ.surface.vertices[:, None] - clean.observation.reference[None], axis=2)
    nearest = distance.argmin(axis=1)
    close = np.flatnonzero(distance.min(axis=1) < 0.002)
    off = clean.observation.displacement[nearest[close]] - truth[close]
    assert np.linalg.norm(off, axis=1).max() < 0.25 * np.linalg.norm(truth, axis=1).max()


def test_attached_region_is_told_wrongly_in_either_direction(samples):
    sample = samples[1]
    rng = np.random.default_rng(0)
    areas = vertex_areas(sample.surface)
    recipe = ViewRecipe(misattached=0.5, misattachment=0.3)
    told = [draw_attachment(sample.surface, sample.attached_mask, recipe, rng) for _ in range(40)]
    ratio = np.array([areas[mask].sum() for mask in told]) / areas[sample.attached_mask].sum()
    assert 0.25 < np.mean(ratio == 1.0) < 0.75
    assert ratio[ratio < 1.0].mean() == pytest.approx(0.7, abs=0.15)
    assert ratio[ratio > 1.0].mean() == pytest.approx(1.3, abs=0.15)


def test_hash_of_the_estimator_follows_what_its_answers_depend_on(tmp_path, monkeypatch):
    copy = tmp_path / "core"
    shutil.copytree(Path(softtissue_estimator.__file__).parent, copy)
    before = posteriors.elastic_code_hash()
    monkeypatch.setattr(softtissue_estimator, "__file__", str(copy / "__init__.py"))
    assert posteriors.elastic_code_hash() == before
    for name, changes in (
        ("config", False),
        ("estimators/paper/estimator", False),
        ("organ/mesh_files/vtk_files", False),
        ("organ/volume_mesh", True),
        ("organ/surface_lookup", True),
    ):
        path = copy / f"{name}.py"
        path.write_text(path.read_text() + "# changed\n")
        assert (posteriors.elastic_code_hash() != before) == changes, name
