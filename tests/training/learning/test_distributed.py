"""Two processes that train together, started by torchrun, against one process."""

import csv
import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from softtissue_training.cli import main
from softtissue_training.learning.batch_source import BatchSource
from softtissue_training.learning.dataset import draw_visible, prepare
from softtissue_training.learning.distributed import Ranks, joined
from softtissue_training.learning.learner import Batch, Learner
from softtissue_training.learning.loss import sample_losses, sigma_losses
from softtissue_training.learning.run_files import LOG, LOSS
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.training_config import get_config
from softtissue_training.learning.voxels import voxelise
from softtissue_training.simulation.archive import record_name, write_record
from softtissue_training.simulation.record_format import format_record

CONFIG = get_config("tiny", batch_size=3)
CPU = torch.device("cpu")


def _torchrun(arguments, **environment):
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def _gradients_of_two_batches(data: Path, ranks: Ranks) -> dict[str, torch.Tensor]:
    """Gradients of the first batches with three samples and with one, which leaves the second process without."""
    dataset = SimulationSet(data, CONFIG, show_progress=False)
    dataset.rescan()
    source = BatchSource(dataset, CONFIG, CPU, ranks)
    learner = Learner(CONFIG, CPU, ranks, bfloat16=False)
    seen = draw_visible(dataset.training[0], np.random.default_rng(0), (0.5, 0.5))
    learner.initialise(voxelise(dataset.training[0], *seen, CONFIG.spec, CPU)[0])
    drawn, wanted = source.drawn(0, 0), {3, 1}
    found = {}
    while wanted:
        batch = next(drawn)
        count = len(batch.place.chosen)
        if count in wanted:
            wanted.remove(count)
            loss = ranks.sum(learner.gradient(source.voxelise(batch)))
            found[f"{count} loss"] = loss
            for name, weight in learner.network.named_parameters():
                found[f"{count} {name}"] = weight.grad.clone()
    drawn.close()
    return found


def test_two_processes_have_the_gradient_of_one(records, tmp_path):
    data = _data_of_one_kind(records, tmp_path / "sims")
    _torchrun([__file__, str(data), str(tmp_path / "gradients")])
    alone = _gradients_of_two_batches(data, Ranks())
    together = load_file(tmp_path / "gradients")
    assert together.keys() == alone.keys()
    for name, expected in alone.items():
        assert float(expected.norm()) > 1e-5, name
        error = float((together[name] - expected).norm()) / float(expected.norm())
        assert error < 1e-5, (name, error)


def _data_of_one_kind(records, folder: Path) -> Path:
    """Four load cases of one organ to train on: an epoch has a batch of three samples and one of one."""
    folder.mkdir()
    sample = records[1].simulations[0]
    cases = tuple(
        dataclasses.replace(sample, displacement=np.float32(1 - 0.2 * case) * sample.displacement, case=case)
        for case in range(4)
    )
    for number, record in ((0, records[0]), (1, dataclasses.replace(records[1], simulations=cases))):
        write_record(folder, record_name(number), format_record(record))
    return folder


@pytest.mark.parametrize("loss", ["squared", "distance"])
def test_gradient_is_that_of_the_mean_over_samples_whatever_their_grids(samples, loss):
    learner = Learner(dataclasses.replace(CONFIG, loss=loss), CPU, Ranks(), bfloat16=False)
    voxels = []
    for number, surroundings in ((1, False), (1, True)):
        prepared = prepare(samples[number], CONFIG.spec, surroundings=surroundings)
        seen = draw_visible(prepared, np.random.default_rng(number), (0.5, 0.5))
        voxels.append(voxelise(prepared, *seen, CONFIG.spec, CPU))
    losses = []
    for inputs, *truth in voxels:
        outputs = learner.network.forward_all(inputs)
        displacement = sample_losses(outputs, *truth, CONFIG.cube_cells, distance=loss == "distance")
        sigma = sigma_losses(outputs[-1], *truth, CONFIG.cube_cells)
        losses.append(displacement + CONFIG.sigma_weight * sigma)
    expected = torch.autograd.grad(torch.cat(losses).mean(), list(learner.network.parameters()))
    total = [torch.zeros_like(weight) for weight in learner.network.parameters()]
    for tensors in voxels:  # what two processes would each add
        learner.gradient(Batch(*tensors, count=2))
        total = [sum_ + weight.grad for sum_, weight in zip(total, learner.network.parameters(), strict=True)]
    for got, wanted in zip(total, expected, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-7)


def test_command_under_torchrun_leaves_the_curve_of_one_process(data_folder, tmp_path):
    arguments = ["train", "--data", str(data_folder), "--config", "tiny", "--steps", "6", "--device", "cpu"]
    arguments += ["--validate-every", "3", "--precision", "float32", "--threads", "1"]
    _torchrun(["-m", "softtissue_training", *arguments, "--out", str(tmp_path / "two")])
    assert main([*arguments, "--out", str(tmp_path / "one")]) == 0

    def column(out, name, file):
        return [float(row[name]) for row in csv.DictReader((tmp_path / out / file).read_text().splitlines())]

    assert len(column("two", "loss", LOSS)) == 6
    np.testing.assert_allclose(column("two", "loss", LOSS), column("one", "loss", LOSS), rtol=1e-4)
    np.testing.assert_allclose(column("two", "error_mm", LOG), column("one", "error_mm", LOG), atol=0.01)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with joined(CPU) as ranks:
        gradients = _gradients_of_two_batches(Path(sys.argv[1]), ranks)
        if ranks.writes:
            save_file({name: value.contiguous() for name, value in gradients.items()}, sys.argv[2])
