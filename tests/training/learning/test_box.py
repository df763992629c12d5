"""Training on organ boxes against the full cube.

Every output of the network sees the whole cube and its edge, so that no margin smaller than the cube makes the answer
on a box that of the cube by itself; one that sees boxes of all sizes while it learns gives nearly the same on both.
"""

import dataclasses

import numpy as np
import pytest
import torch

from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_training.learning.batch_source import fixed_view
from softtissue_training.learning.box import crop, own_box
from softtissue_training.learning.run_files import WEIGHTS
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.train import train
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.voxels import Voxeliser

OVERFIT = get_config("overfit")
# Boxes of 16 and 24 cells in a cube of 32; in the organ's frame, as the paper's network.
BOXES = dataclasses.replace(
    OVERFIT,
    spec=NetworkSpec(
        spacing=0.30 / 32,
        margin_cells=1,
        architecture=dataclasses.replace(get_config("tiny").spec.architecture, in_channels=5, out_channels=3),
    ),
    batch_size=4,
    ema_decay=0.9,
)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def around(data_folder):
    """Four organs with all that surrounds them."""
    dataset = SimulationSet(data_folder, dataclasses.replace(BOXES, larger_box_share=1.0))
    dataset.rescan()
    return dataset.training


def _errors_mm(network, around):
    """Means inside the organs: difference between box and cube, error on the box, error on the cube."""
    found = []
    for index, sample in enumerate(around):
        voxels = Voxeliser(BOXES.spec, CPU)([sample], [fixed_view(sample, index, BOXES)])
        box = own_box(sample.box, sample.grid.shape)
        inputs, target, mask = crop(voxels, box)
        with torch.inference_mode():
            on_box = network(inputs)
            on_cube = network(voxels[0])[(slice(None), slice(None), *box)]
        pairs = ((on_box, on_cube), (on_box, target), (on_cube, target))
        inside = mask[:, 0] > 0
        found.append([float((one - other).norm(dim=1)[inside].mean()) for one, other in pairs])
    return 1e3 * BOXES.spec.output_scale * np.mean(found, axis=0)


def _trained(data, out, share):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        config = dataclasses.replace(BOXES, larger_box_share=share)
        train(data, out, config, Schedule(steps=45, validate_every_steps=45))
    finally:
        torch.set_num_threads(before)
    return load_checkpoint(out / WEIGHTS).network


def test_boxes_of_all_sizes_in_training_make_box_and_cube_agree(data_folder, around, tmp_path):
    assert len({sample.box for sample in around}) > 1
    fixed = _errors_mm(_trained(data_folder, tmp_path / "fixed", 0.0), around)
    varied = _errors_mm(_trained(data_folder, tmp_path / "varied", 0.5), around)
    print("box to cube, box, cube (mm):", fixed.round(2), varied.round(2))
    assert fixed[2] > fixed[1] + 0.5
    assert varied[2] < varied[1] + 0.5
    assert varied[0] < 0.8 * fixed[0]
