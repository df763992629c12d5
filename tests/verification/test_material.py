"""Stress and tangent against finite differences of the energy, at random deformations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.physics.material import LAWS, Material


def _deformations(seed, count=20):
    rng = np.random.default_rng(seed)
    gradients = np.eye(3) + 0.3 * rng.normal(size=(10 * count, 3, 3))
    return gradients[np.linalg.det(gradients) > 0.3][:count]


@pytest.mark.parametrize("law", LAWS)
def test_stress_is_the_derivative_of_the_energy(law):
    material, step = Material(law), 1e-6
    gradients = _deformations(1)
    stress = material.stress(gradients)
    for i in range(3):
        for j in range(3):
            change = np.zeros((3, 3))
            change[i, j] = step
            slope = (material.energy(gradients + change) - material.energy(gradients - change)) / (2 * step)
            np.testing.assert_allclose(stress[:, i, j], slope, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("law", LAWS)
def test_tangent_is_the_derivative_of_the_stress(law):
    material, step = Material(law), 1e-6
    gradients = _deformations(2)
    tangent = material.tangent(gradients)
    for k in range(3):
        for m in range(3):
            change = np.zeros((3, 3))
            change[k, m] = step
            slope = (material.stress(gradients + change) - material.stress(gradients - change)) / (2 * step)
            np.testing.assert_allclose(tangent[:, :, :, k, m], slope, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("law", LAWS)
def test_contracted_tangent_is_the_tangent_between_two_vectors(law):
    material = Material(law)
    gradients = _deformations(6)
    first, second = np.random.default_rng(7).normal(size=(2, len(gradients), 3))
    expected = np.einsum("eJ,eiJkL,eL->eik", first, material.tangent(gradients), second)
    np.testing.assert_allclose(
        material.contracted_tangent(gradients, first, second), expected, rtol=1e-10, atol=1e-9
    )


@pytest.mark.parametrize("law", LAWS)
def test_energy_does_not_change_under_rotation_before_or_after(law):
    material = Material(law)
    gradients = _deformations(3)
    turns = Rotation.random(len(gradients), rng=np.random.default_rng(4)).as_matrix()
    expected = material.energy(gradients)
    np.testing.assert_allclose(material.energy(turns @ gradients), expected, rtol=1e-9)
    np.testing.assert_allclose(material.energy(gradients @ turns), expected, rtol=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_small_strain_gives_hookes_law(law):
    material = Material(law, youngs_modulus_pa=2000.0, poisson_ratio=0.3)
    rng = np.random.default_rng(5)
    strain = 1e-6 * rng.normal(size=(3, 3))
    strain = strain + strain.T
    hooke = 2000.0 / 1.3 * (strain + 0.3 / 0.4 * np.trace(strain) * np.eye(3))
    np.testing.assert_allclose(material.stress(np.eye(3) + strain), hooke, atol=1e-7)


def test_inverted_deformation_has_infinite_energy():
    mirrored = np.diag([-1.0, 1.0, 1.0])
    assert all(np.isinf(Material(law).energy(mirrored)) for law in LAWS)


def test_bad_constants_are_refused():
    with pytest.raises(InvalidInputError, match="between -1 and 0.5, got 0.5"):
        Material(poisson_ratio=0.5)
    with pytest.raises(InvalidInputError, match="must be positive, got -1"):
        Material(youngs_modulus_pa=-1.0)
    with pytest.raises(InvalidInputError, match="neo_hookean, st_venant_kirchhoff, got 'steel'"):
        Material(law="steel")
