"""What the amplitudes' posterior is computed with."""

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic.amplitudes import invert_lower


@pytest.mark.parametrize("size", [1, 7, 250, 251, 640])
def test_a_triangular_matrix_is_inverted_whatever_its_size(size):
    rng = np.random.default_rng(size)
    whole = np.tril(rng.normal(size=(size + 3, size + 3)) / np.sqrt(size)) + 2.0 * np.eye(size + 3)
    # A part of a larger one, as LAPACK leaves it.
    factor = torch.from_numpy(np.asfortranarray(whole))[3:, 3:]
    inverse = invert_lower(factor).numpy()
    np.testing.assert_allclose(inverse @ whole[3:, 3:], np.eye(size), atol=1e-12)
    assert not np.triu(inverse, 1).any()
    np.testing.assert_array_equal(factor.numpy(), whole[3:, 3:])
