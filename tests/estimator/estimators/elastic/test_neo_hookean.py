import numpy as np
import pytest
import torch

from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.elasticity import lame_constants
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.neo_hookean import determinant

CPU = torch.device("cpu")


def test_determinants():
    matrices = torch.randn((20, 3, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(determinant(matrices), torch.linalg.det(matrices))


@pytest.mark.parametrize("collapsed", [False, True])
def test_stress_alone_is_that_beside_the_stiffness(collapsed):
    mesh = box_tets((0.06, 0.04, 0.03), (3, 2, 2))
    count = len(mesh.nodes)
    body = HyperelasticBody(mesh, 0.01 * np.eye(count), np.eye(count)[:, :1], CPU)
    elements = body._elements
    moved = 0.002 * torch.randn((count, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    if collapsed:
        moved[0] += 0.05
    gradient, law = body.deformation_gradient(moved), lame_constants(0.45)
    assert bool((determinant(gradient) < 0.2).any()) == collapsed
    whole = elements.response(gradient, *law).stress
    torch.testing.assert_close(elements.stress(gradient, *law), whole, rtol=1e-10, atol=1e-12)
