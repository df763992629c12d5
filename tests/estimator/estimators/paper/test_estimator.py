"""The U-Net behind the estimator interface: the same numbers as its parts, on any device, from any folder."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from estimator.recorded_on_cpu import recorded_on_cpu
from estimator.waiting_operators import WaitingOperators
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.estimators.paper import estimator as paper_estimator
from softtissue_estimator.estimators.paper.checkpoint import save_checkpoint
from softtissue_estimator.estimators.paper.estimator import PaperEstimator
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_input import (
    assemble_input,
    field_of,
    from_batch,
    input_of,
    organ_channels,
    visible_displacement,
)
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec, rigid_spec
from softtissue_estimator.estimators.paper.residual import ResidualCorrection
from softtissue_estimator.estimators.paper.rigid_frame import fit_frame
from softtissue_estimator.inference.captured_call import CapturedCall
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ, Structure

SPEC = NetworkSpec(spacing=0.006, architecture=UNetArchitecture(widths=(4, 4, 4, 8)))
RIGID_SPEC = rigid_spec(0.006, widths=(4, 4, 4, 8), sigma_scale=0.5)
SPECS = {"organ": SPEC, "rigid": RIGID_SPEC}
STAGES = {
    "organ": {"rasterise", "network", "warp"},
    "rigid": {"rigid", "rasterise", "network", "residual", "warp"},
}


@pytest.fixture(autouse=True)
def _private_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def _stored(folder: Path, spec: NetworkSpec) -> Path:
    torch.manual_seed(2)
    path = folder / "small.safetensors"
    save_checkpoint(path, UNet(spec.architecture), spec, {})
    return path


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return _stored(tmp_path, SPEC)


@pytest.fixture(params=SPECS)
def any_frame(request: pytest.FixtureRequest) -> str:
    """The frame of a network's displacements."""
    return str(request.param)


@pytest.fixture
def any_checkpoint(tmp_path: Path, any_frame: str) -> Path:
    """Of a network in that frame."""
    return _stored(tmp_path, SPECS[any_frame])


@pytest.fixture
def organ() -> Organ:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    surface = SurfaceMesh(np.asarray(sphere.vertices) * [0.06, 0.045, 0.03], np.asarray(sphere.faces))
    tumour = SurfaceMesh(np.asarray(sphere.vertices) * 0.01 + [0.02, 0.0, 0.0], np.asarray(sphere.faces))
    return Organ(
        name="ellipsoid",
        frame="organ",
        surface=surface,
        structures=(Structure("tumour", "tumour", tumour, (1.0, 0.8, 0.2, 1.0)),),
        attached=surface.vertices[:, 0] < -0.04,
        folder=None,
        digest="ellipsoid",
    )


@pytest.fixture
def observation(organ: Organ) -> Observation:
    rng = np.random.default_rng(3)
    visible = organ.surface.vertices[organ.surface.vertices[:, 2] > 0.01]
    return Observation(visible, rng.normal(scale=0.01, size=visible.shape), np.full(len(visible), 0.001))


def _loaded(checkpoint: Path, organ: Organ, device: str = "cpu", precision: str = "auto") -> PaperEstimator:
    estimator = create_estimator(
        EstimatorConfig(estimator="paper", checkpoint=str(checkpoint), device=device, precision=precision)
    )
    assert isinstance(estimator, PaperEstimator)
    estimator.load_organ(organ)
    return estimator


def test_answer_is_the_networks_field_at_the_query_points(
    checkpoint: Path, organ: Organ, observation: Observation
) -> None:
    estimate = _loaded(checkpoint, organ, precision="float32").estimate(observation)
    assert estimate.displacement.shape == organ.query_points.shape and estimate.sigma is None
    assert set(estimate.stages) == STAGES["organ"]

    channels = organ_channels(organ.surface, organ.attached, SPEC)
    visible = visible_displacement(
        channels.grid,
        torch.from_numpy(observation.reference),
        torch.from_numpy(observation.displacement),
        torch.from_numpy(observation.sigma),
    )
    torch.manual_seed(2)
    network = UNet(SPEC.architecture)
    with torch.no_grad():
        field = from_batch(network(assemble_input(channels, visible, SPEC))) * SPEC.output_scale
    # A query point of our own in the middle of a cell well inside the organ: the field's value there, nothing else.
    cell = (channels.signed_distance < -0.015).nonzero()[5]
    centre = np.array(channels.grid.origin) + channels.grid.spacing * cell.numpy()
    got, sigma = estimate.displacement_at(centre[None])
    np.testing.assert_allclose(got[0], field[tuple(cell)].numpy(), atol=1e-7)
    assert sigma is None
    assert np.abs(got).max() > 1e-5


def test_query_points_and_single_points_agree(
    any_checkpoint: Path, organ: Organ, observation: Observation
) -> None:
    estimate = _loaded(any_checkpoint, organ).estimate(observation)
    np.testing.assert_array_equal(estimate.displacement_at(organ.query_points)[0], estimate.displacement)


def _other(observation: Observation) -> Observation:
    return Observation(observation.reference, -observation.displacement[::-1], observation.sigma)


def test_an_answer_stays_valid_after_the_next(
    any_checkpoint: Path, organ: Organ, observation: Observation
) -> None:
    estimator = _loaded(any_checkpoint, organ)
    first = estimator.estimate(observation)
    points = organ.query_points[:50]
    before = (first.displacement.copy(), first.displacement_at(points)[0].copy())
    second = estimator.estimate(_other(observation))
    assert np.abs(second.displacement - first.displacement).max() > 1e-5
    np.testing.assert_array_equal(first.displacement, before[0])
    np.testing.assert_array_equal(first.displacement_at(points)[0], before[1])


def test_a_captured_graph_gives_the_same_answers_in_every_frame(
    any_frame: str,
    any_checkpoint: Path,
    organ: Organ,
    observation: Observation,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain = _loaded(any_checkpoint, organ)
    monkeypatch.setattr(paper_estimator, "CapturedCall", partial(CapturedCall, record=recorded_on_cpu))
    captured = _loaded(any_checkpoint, organ)
    frames = [observation, _other(observation), observation]
    answers = [captured.estimate(frame) for frame in frames]
    assert set(answers[0].stages) == STAGES[any_frame]
    for frame, answer in zip(frames, answers, strict=True):
        expected = plain.estimate(frame)
        np.testing.assert_array_equal(answer.displacement, expected.displacement)
        points = organ.query_points[:50]
        np.testing.assert_array_equal(answer.displacement_at(points)[0], expected.displacement_at(points)[0])


def test_nothing_between_the_points_and_the_answer_waits_for_a_gpu(
    any_checkpoint: Path, organ: Organ, observation: Observation
) -> None:
    estimator = _loaded(any_checkpoint, organ)
    with WaitingOperators() as control:
        torch.tensor([1.0]).sum().item()
    assert control.waiting == {"lift_fresh", "_local_scalar_dense"}
    with WaitingOperators() as found:
        estimator.estimate(observation)
    assert found.count > 50 and found.waiting == set()


@pytest.fixture
def silent_checkpoint(tmp_path: Path) -> Path:
    """Of a network in the rigid frame whose outputs are zero."""
    network = UNet(RIGID_SPEC.architecture)
    with torch.no_grad():
        network.heads[-1].weight.zero_()
        network.heads[-1].bias.zero_()
    path = tmp_path / "silent.safetensors"
    save_checkpoint(path, network, RIGID_SPEC, {})
    return path


def test_no_bend_is_the_rigid_motion_of_what_is_observed(
    silent_checkpoint: Path, organ: Organ, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    turn = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()
    rng = np.random.default_rng(6)
    noise = rng.normal(scale=0.002, size=observation.reference.shape)
    moved = observation.reference @ turn.T + [0.01, -0.02, 0.03] + noise - observation.reference
    # That noise does not fit the motion is another matter.
    monkeypatch.setattr(ResidualCorrection, "__call__", lambda _, field, *__: field)
    seen = Observation(observation.reference, moved, observation.sigma)
    estimate = _loaded(silent_checkpoint, organ).estimate(seen)
    motion = fit_frame(average_patches(seen, organ.surface_lookup))
    assert np.degrees(Rotation.from_matrix(motion.rotation @ turn.T).magnitude()) < 3.0
    expected = motion.apply(organ.query_points) - organ.query_points
    np.testing.assert_allclose(estimate.displacement, expected, rtol=0, atol=1e-12)
    points = np.array([[0.0, 0.0, 0.0], [0.01, 0.02, -0.005], [-0.03, 0.0, 0.01]])
    np.testing.assert_allclose(
        estimate.displacement_at(points)[0], motion.apply(points) - points, rtol=0, atol=1e-12
    )
    assert np.linalg.norm(expected, axis=1).min() > 0.005
    # exp(0) units of 5 mm, halved by the factor that held-out organs gave.
    sigma = estimate.sigma
    assert sigma is not None and sigma.dtype == np.float64
    np.testing.assert_allclose(sigma, 0.0025, rtol=1e-6)


def test_answer_in_the_rigid_frame_is_taken_back_to_the_organs(
    tmp_path: Path, organ: Organ, observation: Observation
) -> None:
    estimate = _loaded(_stored(tmp_path, RIGID_SPEC), organ, precision="float32").estimate(observation)
    channels = organ_channels(organ.surface, organ.attached, RIGID_SPEC)
    motion = fit_frame(average_patches(observation, organ.surface_lookup))
    torch.manual_seed(2)
    network = UNet(RIGID_SPEC.architecture)
    with torch.no_grad():
        outputs = from_batch(network(input_of(organ, channels, observation, RIGID_SPEC)))
        field = field_of(outputs, RIGID_SPEC)
        patches = average_patches(observation, organ.surface_lookup)
        corrected = ResidualCorrection(channels.grid, organ.surface, organ.attached)(field, patches, motion)
    # The middles of cells well inside the organ.
    cells = (channels.signed_distance < -0.015).nonzero()[::7]
    centres = np.array(channels.grid.origin) + channels.grid.spacing * cells.numpy()
    values = corrected[tuple(cells.T)].double().numpy()
    got, sigma = estimate.displacement_at(centres)
    expected = motion.apply(centres + values[:, :3]) - centres
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
    assert np.abs(values[:, :3]).max() > 1e-3
    assert sigma is not None
    log_sigma = outputs[tuple(cells.T)][:, 3].double().numpy()
    np.testing.assert_allclose(sigma, 0.5 * 0.005 * np.exp(log_sigma), rtol=1e-5)


def test_only_a_network_with_four_outputs_gives_a_deviation(
    tmp_path: Path, organ: Organ, observation: Observation
) -> None:
    given = _loaded(_stored(tmp_path, RIGID_SPEC), organ).estimate(observation)
    assert given.sigma is not None and given.sigma.shape == (len(organ.query_points),)
    assert given.sigma.dtype == np.float64 and (given.sigma > 0.0).all()
    at_points = given.displacement_at(organ.query_points[:20])[1]
    assert at_points is not None
    np.testing.assert_array_equal(at_points, given.sigma[:20])
    plain = rigid_spec(0.006, sigma=False, widths=(4, 4, 4, 8))
    none = _loaded(_stored(tmp_path, plain), organ).estimate(observation)
    assert none.sigma is None and none.displacement_at(organ.query_points[:20])[1] is None


def test_precision_of_a_device_that_lacks_it(
    checkpoint: Path, organ: Organ, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = _loaded(checkpoint, organ, precision="float32").estimate(observation)
    monkeypatch.setattr("softtissue_estimator.inference.precision._cpu_has", lambda _: False)
    np.testing.assert_array_equal(
        _loaded(checkpoint, organ).estimate(observation).displacement, expected.displacement
    )
    with pytest.raises(InvalidInputError, match="parameter precision: .* got 'float16' on cpu without"):
        _loaded(checkpoint, organ, precision="float16")


def test_second_load_from_the_cache_gives_the_same_answer(
    any_checkpoint: Path, organ: Organ, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = _loaded(any_checkpoint, organ).estimate(observation)

    def must_not_run(*_: object) -> None:
        raise AssertionError("the channels were computed again")

    monkeypatch.setattr("softtissue_estimator.estimators.paper.network_input.channels_on_grid", must_not_run)
    second = _loaded(any_checkpoint, organ).estimate(observation)
    np.testing.assert_array_equal(first.displacement, second.displacement)


def test_no_organ_yet(checkpoint: Path, observation: Observation) -> None:
    estimator = PaperEstimator(EstimatorConfig(estimator="paper", checkpoint=str(checkpoint), device="cpu"))
    with pytest.raises(InvalidInputError, match="no organ is loaded"):
        estimator.estimate(observation)


def test_missing_checkpoint() -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        create_estimator(EstimatorConfig(estimator="paper", checkpoint="nowhere.safetensors"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_cuda_without_a_gpu(checkpoint: Path) -> None:
    with pytest.raises(InvalidInputError, match="parameter device: expected a CUDA device"):
        create_estimator(EstimatorConfig(estimator="paper", checkpoint=str(checkpoint), device="cuda"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_cpu_and_gpu_agree(any_checkpoint: Path, organ: Organ, observation: Observation) -> None:
    cpu = _loaded(any_checkpoint, organ, "cpu").estimate(observation)
    gpu = _loaded(any_checkpoint, organ, "cuda").estimate(observation)
    np.testing.assert_allclose(gpu.displacement, cpu.displacement, atol=1e-5)
