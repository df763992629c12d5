"""Measures everything in parts; a part that is there is not measured again."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.inference.device import choose_device
from softtissue_estimator.organ.organ import load_organ
from softtissue_training.evaluation.benchmark.machine import busy_cores, machine
from softtissue_training.evaluation.network_timing import time_networks, time_reference
from softtissue_training.evaluation.realtime.finite_elements import time_finite_elements
from softtissue_training.evaluation.realtime.latency_tool import find_latency_tool, run_latency_tool
from softtissue_training.evaluation.realtime.plan import NodeRun, RealtimePlan
from softtissue_training.evaluation.realtime.rings import ring_organ
from softtissue_training.evaluation.timing import TimingPlan, measure

Progress = Callable[[str], None]
Part = dict[str, Any]

_BUSY_CORES = 0.3  # from which on another program is at work
_ALONE_FRAMES = 5  # the elastic estimator takes seconds for one


def run_realtime(plan: RealtimePlan, folder: Path, progress: Progress) -> dict[str, Any]:
    """Measure what a plan asks for and has not been measured yet; return what the report is made of.

    Parameters
    ----------
    plan : RealtimePlan
    folder : Path
        For `parts/*.json` and the organs `organ_*`.
    progress : callable
        Told what is going on.

    Raises
    ------
    InvalidInputError
        Without a built workspace or, for 'cuda', without a GPU: before anything is measured.
    SoftTissueError
        If something fails; what was measured is kept.
    """
    if plan.device == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError("device cuda: expected an NVIDIA GPU on this machine, got none")
    find_latency_tool()
    load = busy_cores()
    if load > _BUSY_CORES:
        progress(f"other programs keep {load:.1f} cores busy: every figure will be worse than it should be")
    organs = {count: folder / f"organ_{count}" for count in plan.vertices}
    for count, path in organs.items():
        ring_organ(path, count, progress)
    parts = Parts(folder / "parts", json.dumps(dataclasses.asdict(plan), sort_keys=True), progress)
    first = organs[plan.vertices[0]]
    found: dict[str, Any] = {
        name: [] for name in ("end_to_end", "starts", "messages", "stages", "alone", "networks", "fem")
    }
    for run in plan.runs:
        name = f"latency_{run.estimator}_{run.vertices}"
        part = parts.get(name, _latency, plan, run, organs[run.vertices], folder)
        found["end_to_end"] += part["end_to_end"]
        found["messages"] += part["messages"]
        start = {key: part[key] for key in ("estimator", "device", "start_to_answer_s")}
        found["starts"].append({**start, "structures_vertices": run.vertices})
    for estimator in plan.estimators:
        part = parts.get(f"stages_{estimator}", _stages, plan, estimator, first, progress)
        found["stages"] += part["results"]
    if not plan.quick:
        found["alone"] = parts.get("stages_alone", _alone, plan, first, progress)["results"]
    if plan.network_repeats:
        found["networks"] = parts.get("networks", _networks, plan, first, progress)["results"]
    for size in plan.element_sizes_m:
        found["fem"].append(parts.get(f"fem_{1e3 * size:g}mm", _finite_elements, plan, size, progress))
    if plan.soak_s > 0.0:
        for estimator in plan.estimators:
            part = parts.get(f"soak_{estimator}", _soak, plan, estimator, first, folder)
            found["end_to_end"] += part["end_to_end"]
    return {"machine": _machine(plan.device, load), "plan": dataclasses.asdict(plan), **found}


class Parts:
    """Results kept as `NAME.json`, each with the plan that it belongs to.

    Parameters
    ----------
    folder : Path
    plan : str
        A part of another plan is measured again.
    progress : callable
        Told what is measured and what is kept.
    """

    def __init__(self, folder: Path, plan: str, progress: Progress) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._plan, self._progress = folder, plan, progress

    def get(self, name: str, measure: Callable[..., Part], *arguments: Any) -> Part:
        """Return a part, measured before or, by calling `measure` with the arguments, now."""
        path = self._folder / f"{name}.json"
        if path.is_file():
            kept = json.loads(path.read_text(encoding="utf-8"))
            if kept["plan"] == self._plan:
                self._progress(f"==> {name}: kept from {kept['date']}")
                found: Part = kept["part"]
                return found
        self._progress(f"==> {name}")
        part = measure(*arguments)
        content = {"plan": self._plan, "date": time.strftime("%Y-%m-%d %H:%M"), "part": part}
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        return part


def _latency(plan: RealtimePlan, run: NodeRun, organ: Path, folder: Path) -> Part:
    arguments = _of_node(plan, run.estimator, organ)
    arguments += ["--points", *map(str, run.points), "--rates", *(f"{rate:g}" for rate in run.rates)]
    arguments += ["--seconds", f"{plan.seconds:g}", "--markers", "--services"]
    if (run.estimator, run.vertices) == (plan.estimators[0], plan.vertices[-1]):
        # Each path at the size that the aims speak of: the most points, the most vertices, one mesh.
        arguments += ["--messages", str(plan.points[-1])]
    if plan.overlays and (run.estimator, run.vertices) == (plan.estimators[0], plan.vertices[0]):
        arguments += ["--overlay", *plan.overlays, "--viewer"]
    return run_latency_tool(arguments, folder / "latency.json")


def _soak(plan: RealtimePlan, estimator: str, organ: Path, folder: Path) -> Part:
    arguments = _of_node(plan, estimator, organ)
    arguments += ["--points", str(plan.middle_points), "--rates", "60", "--seconds", f"{plan.soak_s:g}"]
    return run_latency_tool(arguments, folder / "latency.json")


def _of_node(plan: RealtimePlan, estimator: str, organ: Path) -> list[str]:
    return [
        *("--organ", str(organ), "--estimator", estimator),
        *("--device", plan.device, "--seed", str(plan.seed)),
    ]


def _stages(plan: RealtimePlan, estimator: str, organ: Path, progress: Progress) -> Part:
    timing = TimingPlan((estimator,), plan.stage_points, plan.frames)
    return _measure(plan, organ, timing, True, progress)


def _alone(plan: RealtimePlan, organ: Path, progress: Progress) -> Part:
    """Time the estimators without what a stream gives them: every frame on its own."""
    timing = TimingPlan(plan.estimators, (plan.middle_points,), _ALONE_FRAMES)
    return _measure(plan, organ, timing, False, progress)


def _measure(plan: RealtimePlan, organ: Path, timing: TimingPlan, tracking: bool, progress: Progress) -> Part:
    config = EstimatorConfig(tracking=tracking, device=plan.device)
    return measure(load_organ(organ), timing, config, plan.seed, progress)


def _networks(plan: RealtimePlan, organ: Path, progress: Progress) -> Part:
    config = EstimatorConfig(device=plan.device)
    rows = time_networks(load_organ(organ), config, plan.network_repeats, progress)
    rows += time_reference(choose_device(plan.device), plan.network_repeats, progress)
    return {"results": rows}


def _finite_elements(plan: RealtimePlan, size_m: float, progress: Progress) -> Part:
    return time_finite_elements(size_m, plan.middle_points, plan.fem_repeats, plan.seed, progress)


def _machine(device: str, load: float) -> Part:
    found = machine() | {"load_before": round(load, 2)}
    if device == "cuda":
        found["gpu"] = torch.cuda.get_device_name()
    return found
