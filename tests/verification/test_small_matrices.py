"""Closed forms against LAPACK."""

import numpy as np

from softtissue_training.physics.small_matrices import determinant, inverse


def test_inverse_and_determinant_agree_with_lapack():
    matrices = np.random.default_rng(1).normal(size=(40, 2, 3, 3))
    expected = np.linalg.det(matrices)
    inverses, determinants = inverse(matrices)
    np.testing.assert_allclose(determinant(matrices), expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(determinants, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(inverses, np.linalg.inv(matrices), rtol=1e-9)
    assert inverses.shape == matrices.shape
