"""How long the estimators' networks take alone: plain, as the estimators run them, and in other runtimes."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.inference.device import choose_device
from softtissue_estimator.inference.precision import PRECISIONS, choose_precision
from softtissue_estimator.inference.runtime import NetworkRuntime
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.support.resources import bundled_organ
from softtissue_training.evaluation.network_cases import NetworkCase, paper_case
from softtissue_training.evaluation.other_runtimes import RUNTIMES, missing_packages

Progress = Callable[[str], None]

_CUBE = (64, 64, 64)  # of the paper
_CUBE_REPEATS = 8  # at most: each takes a second
_TIMING_ROUNDS = (
    4  # every runtime has its turn so many times, so that what else the machine does falls on all
)
_REFERENCE_ARCHITECTURE = UNetArchitecture(widths=(32, 64, 64, 192))  # 5.8 million weights
_REFERENCE_SHAPE = (48, 40, 32)
OURS = "this software"


@dataclass(frozen=True, eq=False)
class _Entry:
    """Something to be timed."""

    case: NetworkCase
    runtime: str
    precision: str
    threads: int
    inputs: Tensor
    run: Callable[[Tensor], Tensor]
    own_threads: bool = False  # torch's threads are not its business


def time_networks(
    organ: Organ, config: EstimatorConfig, repeats: int, progress: Progress
) -> list[dict[str, Any]]:
    """Time the bundled network of 'paper' in every way, in turns.

    It is run as plain torch modules in float32 on the paper's cube of 64 cells a side and on the organ's box; as the
    estimators run it, in each format that the device computes in; and, on a CPU, by ONNX Runtime and OpenVINO where
    they are installed.

    Parameters
    ----------
    config
        Its `device` is used.
    repeats
        Timed runs of each; of the slow cube at most eight.

    Returns
    -------
    list
        Of `network`, `runtime`, `precision`, `threads` (of a CPU; 0 on a GPU), `shape` of the grid, `p50_ms`, `p95_ms`,
        `min_ms` (what other programs disturb least) and `difference_mm`: the largest one to the answers of the plain
        network on the same input.

    Raises
    ------
    SoftTissueError
        The organ or the device cannot be used, or `repeats` is below one.
    """
    if repeats < 1:
        raise InvalidInputError(f"repeats: expected at least 1, got {repeats}")
    device = choose_device(config.device)
    case = paper_case(organ, config)
    progress(f"{case.name}: preparing its network for every runtime")
    return _time(_entries(case, device, progress, cube=True), repeats, progress)


def time_reference(device: torch.device, repeats: int, progress: Progress) -> list[dict[str, Any]]:
    """Time a U-Net of 5.8 million weights on a box of 48 x 40 x 32 cells with random weights and input.

    Returns
    -------
    list
        As of `time_networks`, `network` is 'reference'. A millimetre is a twentieth of an output, as in the bundled
        weights.
    """
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    network = UNet(_REFERENCE_ARCHITECTURE).eval().requires_grad_(False)
    inputs = torch.randn((1, _REFERENCE_ARCHITECTURE.in_channels, *_REFERENCE_SHAPE), generator=generator)
    case = NetworkCase("reference", network, inputs, lambda a, b: 20.0 * float((a - b).norm(dim=1).max()))
    return _time(_entries(case, device, progress, cube=False), repeats, progress)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows of `time_networks` as Markdown."""
    lines = [
        "| network | runtime | precision | threads | cells | p50, ms | p95, ms | min, ms | difference, mm |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = " x ".join(str(cells) for cells in row["shape"])
        threads = row["threads"] or "GPU"
        lines.append(
            f"| {row['network']} | {row['runtime']} | {row['precision']} | {threads} | {cells} | {row['p50_ms']:.1f} | "
            f"{row['p95_ms']:.1f} | {row['min_ms']:.1f} | {row['difference_mm']:.4f} |"
        )
    return "\n".join(lines)


def _entries(case: NetworkCase, device: torch.device, progress: Progress, *, cube: bool) -> list[_Entry]:
    box = case.inputs.to(device)
    plain = case.network.to(device)
    every = 0 if device.type == "cuda" else torch.get_num_threads()
    entries = []
    if cube:
        # The time does not depend on the numbers.
        shape = (1, box.shape[1], *_CUBE)
        full = torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device)
        entries.append(_Entry(case, "torch, plain", "float32", every, full, plain))
    entries.append(_Entry(case, "torch, plain", "float32", every, box, plain))
    for name in PRECISIONS:
        try:
            dtype = choose_precision(name, device)
        except InvalidInputError as error:
            progress(f"{case.name}: no row for {name}: {error}")
            continue
        for threads in sorted({min(1, every), every}):
            with _threads(threads):
                runtime = NetworkRuntime(case.network, box.shape, device, dtype, progress)
            entries.append(_Entry(case, OURS, runtime.description, threads, box, runtime))
    for name, prepare in RUNTIMES.items() if device.type == "cpu" else ():
        if missing := missing_packages(name):
            progress(f"{case.name}: no rows for {name}, which needs the packages {', '.join(missing)}")
            continue
        precisions = ("float32",) if name == "ONNX Runtime" else tuple(PRECISIONS)
        for precision in precisions:
            for threads in sorted({1, every}):
                run = prepare(case.network, box, precision, threads)
                entries.append(_Entry(case, name, precision, threads, box, run, own_threads=True))
    return entries


def _time(entries: Sequence[_Entry], repeats: int, progress: Progress) -> list[dict[str, Any]]:
    seconds: list[list[float]] = [[] for _ in entries]
    share = -(-repeats // _TIMING_ROUNDS)
    blocks = -(-repeats // share)
    with torch.inference_mode():
        for block in range(blocks):
            progress(f"{entries[0].case.name}: {len(entries)} rows, turn {block + 1} of {blocks}")
            for entry, measured in zip(entries, seconds, strict=True):
                with _alone(entry):
                    turns = min(share, _CUBE_REPEATS // _TIMING_ROUNDS) if _is_cube(entry) else share
                    for number in range(turns + 1):
                        elapsed = _seconds(entry)
                        if number:  # the first after another runtime's turn finds the caches empty
                            measured.append(elapsed)
        return [_row(entry, times) for entry, times in zip(entries, seconds, strict=True)]


def _is_cube(entry: _Entry) -> bool:
    return entry.inputs.shape != entry.case.inputs.shape


def _seconds(entry: _Entry) -> float:
    cuda = entry.inputs.device.type == "cuda"
    if cuda:
        torch.cuda.synchronize()
    began = time.perf_counter()
    entry.run(entry.inputs)
    if cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - began


def _row(entry: _Entry, seconds: Sequence[float]) -> dict[str, Any]:
    difference = 0.0
    if not _is_cube(entry):
        expected, found = (run(entry.inputs).cpu() for run in (entry.case.network, entry.run))
        difference = entry.case.difference_mm(found, expected)
    milliseconds = 1e3 * np.array(seconds)
    return {
        "network": entry.case.name,
        "runtime": entry.runtime,
        "precision": entry.precision,
        "threads": entry.threads,
        "shape": list(entry.inputs.shape[2:]),
        "p50_ms": round(float(np.median(milliseconds)), 3),
        "p95_ms": round(float(np.quantile(milliseconds, 0.95)), 3),
        "min_ms": round(float(milliseconds.min()), 3),
        "difference_mm": round(difference, 5),
    }


def _alone(entry: _Entry) -> AbstractContextManager[None]:
    return _threads(0 if entry.own_threads else entry.threads)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Let torch use so many threads; 0 for as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table for an organ."""
    parser = argparse.ArgumentParser(prog="python -m softtissue_training.evaluation.network_timing")
    parser.add_argument("--organ", type=Path, help="organ folder (default: the bundled one)")
    parser.add_argument("--device", default="auto", choices=("auto", "cuda", "cpu"))
    parser.add_argument(
        "--repeats", type=int, default=40, metavar="N", help="timed runs of each (default: 40)"
    )
    options = parser.parse_args(arguments)

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    try:
        config = EstimatorConfig(device=options.device)
        rows = time_networks(load_organ(options.organ or bundled_organ()), config, options.repeats, say)
        rows += time_reference(choose_device(options.device), options.repeats, say)
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
