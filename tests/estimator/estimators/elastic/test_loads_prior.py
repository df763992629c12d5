"""What loads there may be before anything is observed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.elastic.layered_cholesky import LayeredFactor, Layers
from softtissue_estimator.estimators.elastic.loads_prior import LoadsPrior
from softtissue_estimator.estimators.elastic.tangent import Stiffness, Tangent

NODES = torch.arange(4)
RESPONSE = torch.randn(12, 15, generator=torch.Generator().manual_seed(1))
NOTHING = Stiffness(LayeredFactor(Layers(np.arange(0), np.arange(1)), [], []))
TANGENT = Tangent(torch.zeros(4, 3), torch.zeros(4, 3), RESPONSE, NOTHING)


def spread(variances, loads):
    """Root mean square of a component of the nodes' displacement by some loads with variances, m."""
    columns = (3 * loads[:, None] + torch.arange(3)).reshape(-1)
    part = RESPONSE[:, columns].double() * variances[loads].sqrt().repeat_interleave(3)
    return float(part.square().sum(dim=1).mean().sqrt())


@pytest.mark.parametrize("moves", [False, True])
def test_loads_that_push_move_the_organ_as_far_as_expected_whatever_else_may(moves):
    prior = LoadsPrior(0.01, 3, moves)
    variances = prior.variances(TANGENT, NODES)
    assert spread(variances, torch.arange(3)) == pytest.approx(0.01, rel=1e-5)
    behind = spread(variances, torch.arange(3, 5))
    assert (behind > 1e-3) == moves and (behind < 1e-6) != moves


def test_of_some_loads_those_that_push_are_told_by_their_numbers():
    part = replace(TANGENT, response=RESPONSE[:, 6:].contiguous())
    loads = torch.tensor([2, 3, 4])
    variances = LoadsPrior(0.01, 3).variances(part, NODES, loads)
    assert variances[0] > 1e6 * variances[1] == 1e6 * variances[2]
    every = torch.ones(3)
    assert LoadsPrior(0.01, 3).held(every, loads).tolist() == pytest.approx([1.0, 1e-9, 1e-9])
    assert every.tolist() == [1.0, 1.0, 1.0]
    assert LoadsPrior(0.01, 3, attachment_moves=True).held(every, loads) is every
