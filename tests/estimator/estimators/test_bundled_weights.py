"""The weights that come with the package: the paper's network, and better than no estimate at all."""

import json

import numpy as np
import pytest

from softtissue_estimator.estimators.paper.checkpoint import Checkpoint, load_checkpoint
from softtissue_estimator.estimators.paper.network import UNetArchitecture, parameter_count
from softtissue_estimator.estimators.paper.network_spec import CHANNELS, OBSERVED, RIGID_UNIT_M
from softtissue_estimator.estimators.paper.rigid_frame import RIGID
from softtissue_estimator.support.resources import bundled_checkpoint


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return load_checkpoint(bundled_checkpoint())


def test_they_are_the_papers_network(checkpoint: Checkpoint) -> None:
    # Beside the paper's own, a channel for what was observed and, at every resolution, one for the deviation.
    widths = UNetArchitecture().widths
    more = 27 * widths[0] + sum(27 * width + 1 for width in widths)
    assert checkpoint.spec.architecture == UNetArchitecture(in_channels=6, out_channels=4)
    assert parameter_count(checkpoint.network.requires_grad_(True)) == 9_080_844 + more
    assert checkpoint.spec.channels == (*CHANNELS, OBSERVED)
    assert checkpoint.spec.frame == RIGID and checkpoint.spec.gives_sigma
    # The paper's proportion of distance and flag; displacements in units of what is left to tell apart.
    scales = np.array(checkpoint.spec.input_scales)
    np.testing.assert_allclose(scales * RIGID_UNIT_M, [0.025, 1.0, 1.0, 1.0, 0.025, RIGID_UNIT_M])
    assert checkpoint.spec.output_scale == RIGID_UNIT_M


def test_they_say_where_they_come_from(checkpoint: Checkpoint) -> None:
    provenance = checkpoint.provenance
    assert provenance["command"].startswith("softtissue-train train")
    assert len(provenance["data_sha256"]) == 64 and provenance["simulations"] >= 1000
    assert provenance["validation_error_mm"] < provenance["validation_displacement_mm"]
    # The product speaks of itself alone: no folder of the machine that trained them.
    assert "/" not in json.dumps(provenance)


def test_file_stays_below_twenty_megabytes() -> None:
    assert bundled_checkpoint().stat().st_size < 20_000_000
