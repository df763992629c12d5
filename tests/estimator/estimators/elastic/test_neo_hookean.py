import torch

from softtissue_estimator.estimators.elastic.neo_hookean import determinant


def test_determinants():
    matrices = torch.randn((20, 3, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(determinant(matrices), torch.linalg.det(matrices))
