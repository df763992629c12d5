"""The hybrid estimator behind the interface of every estimator, beside the elastic one on which it builds."""

from functools import partial

import numpy as np
import pytest
import torch

from estimator.recorded_on_cpu import recorded_on_cpu
from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from estimator.waiting_operators import WaitingOperators
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.estimators.hybrid import estimator as hybrid_estimator
from softtissue_estimator.estimators.hybrid.checkpoint import load_hybrid_checkpoint, save_hybrid_checkpoint
from softtissue_estimator.estimators.hybrid.input import HybridSpec
from softtissue_estimator.estimators.hybrid.network import HybridArchitecture, HybridNetwork, initialise
from softtissue_estimator.estimators.paper.checkpoint import checkpoint_kind, load_checkpoint, read_provenance
from softtissue_estimator.inference.captured_call import CapturedCall
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import sample_faces

SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=3)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.05, ellipsoid_tets((0.08, 0.05, 0.04)))
SPEC = HybridSpec(architecture=HybridArchitecture(widths=(8, 8), groups=2))


def bent(points):
    """Smooth field, zero where x < -0.05: the free end bends towards z."""
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, 0.0 * lever, 1.2 * lever**2])


@pytest.fixture(scope="module")
def observation():
    visible = SURFACE.triangles.mean(axis=1)[:, 2] > 0.01
    points = sample_faces(SURFACE, visible, 0.004)[0]
    return Observation(points, bent(points), np.full(len(points), 2e-4))


@pytest.fixture(scope="module")
def network():
    made = HybridNetwork(SPEC.architecture)
    initialise(made, torch.Generator().manual_seed(0))
    return made


def with_output(network, bias):
    """Let a network answer the same four numbers everywhere."""
    made = HybridNetwork(network.architecture)
    made.load_state_dict(network.state_dict())
    with torch.no_grad():
        made.heads[0].bias.copy_(torch.tensor(bias))
    return made


def estimator_of(path, network, spec=SPEC):
    save_hybrid_checkpoint(path, network, spec, {"command": "train it"})
    made = create_estimator(EstimatorConfig(estimator="hybrid", checkpoint=str(path), device="cpu"))
    made.load_organ(ORGAN)
    return made


def test_untrained_it_is_the_elastic_estimator_to_the_last_bit(tmp_path, network, observation):
    hybrid = estimator_of(tmp_path / "zero.safetensors", network).estimate(observation)
    elastic = ElasticEstimator(EstimatorConfig())
    elastic.load_organ(ORGAN)
    expected = elastic.estimate(observation)
    points = np.random.default_rng(0).uniform(-0.03, 0.03, size=(40, 3))
    inner = hybrid._elastic
    ours = (hybrid.displacement, hybrid.sigma, *hybrid.displacement_at(points))
    own = (inner.displacement, inner.sigma, *inner.displacement_at(points))
    another = (expected.displacement, expected.sigma, *expected.displacement_at(points))
    for found, same, close in zip(ours, own, another, strict=True):
        np.testing.assert_array_equal(found, same)
        np.testing.assert_allclose(found, close, atol=1e-12)  # linear algebra may round differently elsewhere
    assert set(hybrid.stages) == set(expected.stages) | {"channels", "network", "remainder"}


def test_outputs_move_points_by_parts_of_the_elastic_deviation(tmp_path, network, observation):
    zero = estimator_of(tmp_path / "zero.safetensors", network).estimate(observation)
    moved = with_output(network, [0.01, 0.0, -0.02, 0.1])
    made = estimator_of(tmp_path / "moved.safetensors", moved, HybridSpec(architecture=SPEC.architecture))
    estimate = made.estimate(observation)
    expected = zero.displacement + zero.sigma[:, None] * [0.01, 0.0, -0.02]
    np.testing.assert_allclose(estimate.displacement, expected, atol=1e-8)
    np.testing.assert_allclose(estimate.sigma, zero.sigma * np.exp(0.1), rtol=1e-3)
    at_vertices = estimate.displacement_at(SURFACE.vertices)
    np.testing.assert_allclose(at_vertices[0], estimate.displacement, atol=1e-9)
    np.testing.assert_allclose(at_vertices[1], estimate.sigma, rtol=1e-6)


def test_it_reads_the_posterior_and_the_observation(tmp_path, network, observation, monkeypatch):
    given = []
    assemble = hybrid_estimator.assemble_hybrid_input
    monkeypatch.setattr(hybrid_estimator, "assemble_hybrid_input", lambda *a: given.append(a) or assemble(*a))
    made = estimator_of(tmp_path / "zero.safetensors", network)
    estimate = made.estimate(observation)
    channels, cells, mean, sigma, observed, _ = given[0]
    centres = channels.grid.points()[cells.numpy()]
    expected = estimate.displacement_at(centres)
    inside = channels.signed_distance.reshape(-1)[cells].numpy() < -0.002
    assert inside.sum() > 100
    np.testing.assert_allclose(mean.numpy()[inside], expected[0][inside], atol=1e-12)
    np.testing.assert_allclose(sigma.numpy()[inside], expected[1][inside], rtol=1e-12)
    # So far apart that every point is a patch of its own.
    points = SURFACE.vertices[:1]
    for point in SURFACE.vertices[SURFACE.vertices[:, 2] > 0.01]:
        if np.linalg.norm(points - point, axis=1).min() > 0.009:
            points = np.append(points, [point], axis=0)
    noise = 0.0025 * np.random.default_rng(1).normal(size=points.shape)
    estimate = made.estimate(Observation(points, bent(points) + noise, np.full(len(points), 0.003)))
    observed = given[1][4]
    order = [np.lexsort(np.round(found, 9).T) for found in (points, observed.reference.numpy())]
    np.testing.assert_allclose(observed.reference.numpy()[order[1]], points[order[0]], atol=1e-12)
    wanted = (bent(points) + noise - estimate.displacement_at(points)[0])[order[0]]
    np.testing.assert_allclose(observed.misfit.numpy()[order[1]], wanted, atol=5e-4)
    assert np.linalg.norm(wanted, axis=1).max() > 3e-3
    assert (observed.sigma.numpy() >= 0.00299).all()


def test_an_organ_that_cannot_be_used_leaves_the_one_before(tmp_path, network, observation):
    made = estimator_of(tmp_path / "zero.safetensors", network)
    before = made.estimate(observation).displacement
    inside_out = type(SURFACE)(SURFACE.vertices, SURFACE.faces[:, ::-1])
    with pytest.raises(Exception, match="positive volume"):
        made.load_organ(organ_of(inside_out))
    np.testing.assert_array_equal(made.estimate(observation).displacement, before)


def test_without_an_organ_or_weights_one_sentence_says_so(tmp_path, network, observation, monkeypatch):
    path = tmp_path / "zero.safetensors"
    save_hybrid_checkpoint(path, network, SPEC, {})
    made = create_estimator(EstimatorConfig(estimator="hybrid", checkpoint=str(path)))
    with pytest.raises(InvalidInputError, match="expected load_organ before the first observation"):
        made.estimate(observation)

    def absent(_):
        raise InvalidInputError("none")

    monkeypatch.setattr(hybrid_estimator, "bundled_checkpoint", absent)
    with pytest.raises(CheckpointError, match="expected weights in the parameter checkpoint .* got neither"):
        create_estimator(EstimatorConfig(estimator="hybrid"))


def test_a_checkpoint_says_all_that_the_network_needs(tmp_path, network):
    path = tmp_path / "weights.safetensors"
    spec = HybridSpec(
        spacing=0.006, sigma_factor=0.8, remainder_limit=2.0, architecture=SPEC.architecture, margin_cells=2
    )
    save_hybrid_checkpoint(path, network, spec, {"command": "train it"}, half=True)
    stored = load_hybrid_checkpoint(path)
    assert (stored.spec, stored.provenance) == (spec, {"command": "train it"})
    assert (checkpoint_kind(path), read_provenance(path)) == ("hybrid", {"command": "train it"})
    for name, weight in network.state_dict().items():
        torch.testing.assert_close(stored.network.state_dict()[name], weight, atol=1e-3, rtol=1e-3)
    with pytest.raises(CheckpointError, match="expected weights of 'paper', got weights of 'hybrid'"):
        load_checkpoint(path)


def test_channels_of_another_version_are_refused(tmp_path, network):
    path = tmp_path / "weights.safetensors"
    save_hybrid_checkpoint(
        path, network, HybridSpec(channels=("a",) * 10, architecture=SPEC.architecture), {}
    )
    with pytest.raises(CheckpointError, match="reads other channels: expected signed_distance, .* got a, a"):
        load_hybrid_checkpoint(path)
    save_hybrid_checkpoint(path, network, HybridSpec(input_scales=(1.0,), architecture=SPEC.architecture), {})
    with pytest.raises(CheckpointError, match="names 10 channels and 1 scales"):
        load_hybrid_checkpoint(path)


@pytest.mark.parametrize("channel", [3, None, [], 0.5])
def test_channels_that_are_no_names_are_refused(tmp_path, network, channel):
    path = tmp_path / "weights.safetensors"
    spec = HybridSpec(channels=("a",) * 9 + (channel,), architecture=SPEC.architecture)
    save_hybrid_checkpoint(path, network, spec, {})
    with pytest.raises(CheckpointError, match="channels: expected a value of its kind, got tuple"):
        load_hybrid_checkpoint(path)


def test_a_captured_graph_gives_the_same_answers_and_each_stays_valid(
    tmp_path, network, observation, monkeypatch
):
    path = tmp_path / "moved.safetensors"
    moved = with_output(network, [0.3, -0.2, 0.1, 0.2])
    with torch.no_grad():
        moved.heads[0].weight.normal_(0.0, 0.1, generator=torch.Generator().manual_seed(1))
    other = Observation(observation.reference, -observation.displacement, observation.sigma)
    plain = estimator_of(path, moved)
    monkeypatch.setattr(hybrid_estimator, "CapturedCall", partial(CapturedCall, record=recorded_on_cpu))
    captured = estimator_of(path, moved)
    frames = [observation, other, observation]
    answers = [captured.estimate(frame) for frame in frames]
    points = SURFACE.vertices[::20]
    for frame, answer in zip(frames, answers, strict=True):
        expected = plain.estimate(frame)
        for found, wanted in (
            (answer.displacement, expected.displacement),
            (answer.sigma, expected.sigma),
            (answer.displacement_at(points)[0], expected.displacement_at(points)[0]),
        ):
            np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.abs(answers[0].sigma / answers[1].sigma - 1.0).max() > 1e-3


def test_nothing_between_the_channels_and_the_answer_waits_for_a_gpu(
    tmp_path, network, observation, monkeypatch
):
    made = estimator_of(tmp_path / "zero.safetensors", network)
    elastic = made._elastic.estimate(observation)
    monkeypatch.setattr(made._elastic, "estimate", lambda _: elastic)
    with WaitingOperators() as found:
        made.estimate(observation)
    assert found.count > 50 and found.waiting == set()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_the_gpu_gives_the_same_answer(tmp_path, network, observation):
    path = tmp_path / "moved.safetensors"
    on_cpu = estimator_of(path, with_output(network, [0.3, -0.2, 0.1, 0.2]))
    on_gpu = create_estimator(EstimatorConfig(estimator="hybrid", checkpoint=str(path), device="cuda"))
    on_gpu.load_organ(ORGAN)
    expected, found = on_cpu.estimate(observation), on_gpu.estimate(observation)
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=2e-5)
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-2)
