"""The simulated breathing liver: its tissue, what surrounds it, its scans, and that a seed decides everything."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.experiments.breathing.case import load_case
from softtissue_training.experiments.breathing_liver import __main__ as command
from softtissue_training.experiments.breathing_liver.breath import CAVA_REACH_M, surroundings
from softtissue_training.experiments.breathing_liver.build import coarse, describe
from softtissue_training.experiments.breathing_liver.exponential_tissue import (
    ExponentialTissue,
    exponential_tissue,
)
from softtissue_training.experiments.breathing_liver.scan import segment
from softtissue_training.experiments.breathing_liver.spec import BreathingSpec
from softtissue_training.organs.tetrahedralise import tetrahedralise
from softtissue_training.phantom.isosurface import isosurface
from softtissue_training.phantom.quadratic_mesh import to_quadratic

CONSTANTS = torch.tensor([900.0, 2.5, 20_000.0], dtype=torch.float64)
COARSE = coarse(BreathingSpec())


def deformation_gradients(count=6, size=0.2):
    generator = torch.Generator().manual_seed(5)
    f = torch.eye(3, dtype=torch.float64) + size * torch.randn(
        count, 3, 3, generator=generator, dtype=torch.float64
    )
    return f[torch.linalg.det(f) > 0.3]


def test_stress_and_tangent_are_the_derivatives_of_the_energy():
    f = deformation_gradients()
    assert len(f) >= 3
    stress, tangent = ExponentialTissue.stress_and_tangent(f, CONSTANTS.expand(len(f), 3))
    energy = ExponentialTissue.energy_density
    for number in range(len(f)):
        expected = torch.func.grad(energy)(f[number], CONSTANTS)
        torch.testing.assert_close(stress[number], expected, rtol=1e-10, atol=1e-8)
        expected = torch.func.jacrev(torch.func.grad(energy))(f[number], CONSTANTS)
        torch.testing.assert_close(tangent[number], expected, rtol=1e-9, atol=1e-7)


def test_energy_does_not_change_with_a_rotation():
    f = deformation_gradients(1)[0]
    turn = torch.tensor(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix())
    energy = ExponentialTissue.energy_density
    torch.testing.assert_close(energy(turn @ f, CONSTANTS), energy(f, CONSTANTS))


def test_small_strain_has_the_wanted_moduli():
    young, nu = 2500.0, 0.48
    tissue = exponential_tissue(young, nu, 3.0)
    rest = torch.eye(3, dtype=torch.float64)[None]
    constants = torch.tensor([tissue.constants], dtype=torch.float64)
    stress, tangent = ExponentialTissue.stress_and_tangent(rest, constants)
    assert_allclose(stress, 0.0, atol=1e-9)
    stiffness = tangent[0].numpy()
    # Sideways free: sigma_xx = E eps_xx, eps_yy = -nu eps_xx (Hooke).
    normal = np.array([[stiffness[i, i, j, j] for j in range(3)] for i in range(3)])
    strain = np.linalg.solve(normal, [1.0, 0.0, 0.0])
    assert_allclose([1.0 / strain[0], -strain[1] / strain[0]], [young, nu], rtol=1e-9)
    assert_allclose(stiffness[0, 1, 0, 1], young / (2.0 * (1.0 + nu)), rtol=1e-9)


def test_tissue_stiffens_when_it_is_sheared():
    def shear_stress(amount):
        f = torch.eye(3, dtype=torch.float64)[None].clone()
        f[0, 0, 1] = amount
        return float(ExponentialTissue.stress_and_tangent(f, CONSTANTS[None])[0][0, 0, 1])

    # Simple shear by g: I1 - 3 = g^2, so the stress is mu g exp(b g^2).
    for amount in (0.1, 0.5):
        assert_allclose(shear_stress(amount), 900.0 * amount * np.exp(2.5 * amount**2), rtol=1e-12)


@pytest.mark.parametrize("values", [(0.0, 0.4, 1.0), (1e3, 0.5, 1.0), (1e3, 0.4, 0.0)])
def test_tissue_refuses_impossible_constants(values):
    with pytest.raises(InvalidInputError, match="expected E > 0"):
        exponential_tissue(*values)


def test_scan_finds_a_ball_with_the_stated_error():
    radius, error = 0.03, 0.0008
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh = SurfaceMesh(np.array(ball.vertices), np.array(ball.faces))
    exact = segment(mesh, 0.005, 0.0, 0.008, np.random.default_rng(1))
    assert_allclose(np.linalg.norm(exact.vertices, axis=1), radius, atol=1.5e-4)
    assert len(exact.vertices) != len(mesh.vertices)
    off = (
        np.linalg.norm(segment(mesh, 0.005, error, 0.008, np.random.default_rng(1)).vertices, axis=1) - radius
    )
    assert np.sqrt((off**2).mean()) == pytest.approx(error, rel=0.4)
    assert enclosed_volume(exact) > 0.0


@pytest.fixture(scope="module")
def made(coarse_breathing_liver):
    return coarse_breathing_liver


@pytest.fixture(scope="module")
def around(made):
    anatomy = made[0].anatomy
    surface = isosurface(anatomy.shape, *anatomy.shape.box, 0.022)
    mesh = to_quadratic(tetrahedralise(surface, 0.026))
    return mesh, surroundings(mesh, anatomy, COARSE), surface


def test_weight_is_that_of_the_volume_and_points_to_the_back(around):
    _, loads, surface = around
    expected = COARSE.gravity * 1060.0 * 9.81 * enclosed_volume(surface)
    assert_allclose(loads.weight.sum(axis=0), [0.0, expected, 0.0], rtol=1e-6, atol=1e-12)


def test_diaphragm_pulls_across_itself_towards_the_feet(around):
    mesh, loads, _ = around
    loaded = np.linalg.norm(loads.breath, axis=1) > 0.0
    assert loads.breath[:, 2].sum() < 0.0
    # Only the upper surface is loaded; the pull is the springs' at the wanted displacement, never along them.
    assert mesh.nodes[loaded, 2].mean() > mesh.nodes[:, 2].mean() + 0.02
    wanted = np.zeros_like(mesh.nodes)
    wanted[:, 2] = -COARSE.breath_m
    springs = np.einsum("nij,nj->ni", loads.springs, wanted)
    assert (np.sum(springs * loads.breath, axis=1) >= -1e-12).all()


def test_springs_hold_everywhere_on_the_surface_and_nowhere_inside(around):
    mesh, loads, _ = around
    stiffness = np.linalg.eigvalsh(loads.springs)
    boundary = np.zeros(len(mesh.nodes), dtype=bool)
    boundary[mesh.face_midsides] = True
    assert (stiffness >= -1e-9).all()
    assert (stiffness[boundary].max(axis=1) > 0.0).all()
    assert not loads.springs[~boundary].any()


def test_liver_is_attached_to_the_vena_cava(made, around):
    mesh, loads, _ = around
    assert 0 < loads.attached.sum() < 0.1 * len(mesh.nodes)
    distance = np.abs(signed_distance(made[0].anatomy.cava, mesh.nodes[loads.attached]))
    assert distance.max() <= CAVA_REACH_M + 1e-9


def test_breath_is_in_equilibrium_and_moves_the_upper_surface_down(made):
    liver = made[0]
    assert max(state.residual for state in liver.breath.equilibria) < 1e-8
    surface = liver.anatomy.surface
    exhaled, inhaled = liver.breath.states(surface.vertices)
    moved = inhaled - exhaled
    top = surface.vertices[:, 2] > np.percentile(surface.vertices[:, 2], 90)
    assert -0.021 < moved[top, 2].mean() < -0.010
    assert np.abs(moved[:, 2]).max() < 0.026


def test_case_that_was_made_is_one_that_a_user_could_have_written(made):
    case = load_case(made[1])
    assert [structure.name for structure in case.compared] == ["portal vein", "hepatic veins", "tumour"]
    assert case.organ.attached.any()
    truth = case.truth
    inside = truth.part == "inside"
    assert (signed_distance(case.organ.surface, truth.before[inside]) < 0.002).all()
    assert (signed_distance(case.surface, truth.after[inside]) < 0.002).all()


def test_command_makes_the_same_bytes_from_the_same_seed(made, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "BreathingSpec", lambda: COARSE)
    monkeypatch.setattr(command.BreathingSpec, "seed", COARSE.seed, raising=False)
    assert command.main(["--out", str(tmp_path), "--seed", str(COARSE.seed)]) == 0
    assert capsys.readouterr().out.startswith(describe(made[0], COARSE))
    for path in made[1].iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name


def test_another_seed_is_another_liver(made):
    other = replace(COARSE, seed=5)
    from softtissue_training.experiments.breathing_liver.liver import build_anatomy

    anatomy = build_anatomy(other, np.random.default_rng(other.seed))
    assert enclosed_volume(anatomy.surface) != pytest.approx(
        enclosed_volume(made[0].anatomy.surface), rel=1e-3
    )
