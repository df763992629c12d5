"""Replay a bag into a node for long, load another organ now and then, and say what became of clouds and memory.

As a program: `scripts/run python tests/integration/soak.py --minutes 10 --rate 3`; exit code 1 if anything is not as it
should be. Figures go to out/soak/soak.json.
"""

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import yaml
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.srv import LoadOrgan
from tqdm import tqdm

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

from integration.harness import NodeProcess, PlainClient, executable
from integration.scene import nanoseconds
from ros_domain import environment_of, reserved
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_bag, bundled_organ

LONGEST_GAP_S = 0.5
MOST_GROWTH = {"memory_mb": 30.0, "threads": 1.0, "descriptors": 2.0}
MOST_GAPS = 10
SAMPLE_S = 1.0
SHORTEST_FOR_GROWTH_S = 300.0  # in less time the first loads alone make memory grow
FORGET_CACHE_EVERY = 3  # loads


@dataclass(frozen=True)
class Plan:
    """How long, how fast (multiple of the bag's rate), how often another organ is loaded (s), for which estimator."""

    seconds: float
    rate: float
    load_every_s: float = 20.0
    estimator: str = "elastic"
    least_loads: int = 1
    longest_gap_s: float = LONGEST_GAP_S

    @property
    def warm_up_s(self) -> float:
        """Before that memory is not looked at: both organs have been loaded, libraries are set up."""
        return min(0.25 * self.seconds, 120.0)


@dataclass
class Heard:
    """What a client heard, without what would fill its memory; seconds on the monotonic clock."""

    clouds_s: list[float] = field(default_factory=list)
    answers_s: list[float] = field(default_factory=list)
    latencies_s: list[float] = field(default_factory=list)
    size_of: dict[int, int] = field(default_factory=dict)  # vertices of the answer to a stamp
    organ_of: dict[int, str] = field(default_factory=dict)  # organ that the status of a stamp names
    last: EstimatorStatus | None = None

    def cloud(self, _data: bytes) -> None:
        self.clouds_s.append(time.monotonic())

    def answer(self, message: PointCloud2) -> None:
        stamp = nanoseconds(message.header.stamp)
        self.answers_s.append(time.monotonic())
        self.latencies_s.append((time.time_ns() - stamp) / 1e9)
        self.size_of[stamp] = message.width

    def status(self, message: EstimatorStatus) -> None:
        self.last = message
        if message.level != EstimatorStatus.INVALID:
            self.organ_of[nanoseconds(message.header.stamp)] = message.organ


@dataclass
class Soak:
    """What was measured.

    Attributes
    ----------
    gaps : list
        Of the longest gaps of answers: when they began and how long they were, s.
    loads : list
        Of every load: when it was asked for and how long it took, s; whether the cache was empty; what was said.
    samples : list
        Of the node's process: time, s; memory, MB; threads; descriptors; how many programs want to run on the machine.
    """

    plan: Plan
    sent: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    gap_s: float = np.inf
    gaps: list[dict] = field(default_factory=list)
    gap_of_clouds_s: float = np.inf
    latency_ms: dict[str, float] = field(default_factory=dict)
    loads: list[dict] = field(default_factory=list)
    samples: list[dict] = field(default_factory=list)
    mislabelled: int = 0
    labelled: dict[str, int] = field(default_factory=dict)
    exit_code: int = -1
    traceback: bool = False

    def growth(self, what: str) -> float:
        """Median of the last third of the samples after the warm-up over that of their first third."""
        values = [sample[what] for sample in self.samples if sample["at_s"] > self.plan.warm_up_s]
        third = len(values) // 3
        return float(np.median(values[-third:]) - np.median(values[:third])) if third else 0.0

    def wrong(self) -> list[str]:
        """What is not as it should be, in sentences."""
        counts, said = self.counts, []
        settled = counts["answered"] + counts["dropped"] + counts["refused"]
        if counts["received"] != settled or not counts["answered"]:
            said.append(f"counts do not balance: {counts}")
        most = self.plan.longest_gap_s
        if self.gap_s > most:
            said.append(f"gap of answers: expected at most {most} s, got {self.gap_s:.2f} s")
        for what, most in MOST_GROWTH.items():
            if self.plan.seconds >= SHORTEST_FOR_GROWTH_S and self.growth(what) > most:
                said.append(f"{what}: expected to grow by at most {most}, got {self.growth(what):.1f}")
        failed = [load for load in self.loads if load["result"] != LoadOrgan.Response.SUCCESS]
        if failed or not self.loads:
            said.append(f"loads: expected some, all with success, got {failed or 'none'}")
        if self.mislabelled or len(self.labelled) < 2:
            said.append(
                f"labels: {self.mislabelled} answers of another organ than named, named {self.labelled}"
            )
        if self.exit_code != 0 or self.traceback:
            said.append(f"exit code {self.exit_code}, traceback in the log: {self.traceback}")
        return said

    def rows(self) -> list[tuple[str, str]]:
        """The table that is printed."""
        after = [sample for sample in self.samples if sample["at_s"] > self.plan.warm_up_s]
        took = sorted(load["took_s"] for load in self.loads)
        rows = [
            ("clouds sent, received", f"{self.sent}, {self.counts['received']}"),
            ("answered, dropped, refused", "{answered}, {dropped}, {refused}".format(**self.counts)),
            ("latency p50, p95, p99, max (ms)", ", ".join(f"{v:.0f}" for v in self.latency_ms.values())),
            (
                "longest gap of answers, of clouds (ms)",
                f"{1e3 * self.gap_s:.0f}, {1e3 * self.gap_of_clouds_s:.0f}",
            ),
            (
                "loads, median, longest (s)",
                f"{len(took)}, {np.median(took):.1f}, {took[-1]:.1f}" if took else "0",
            ),
        ]
        for what in MOST_GROWTH:
            values = [sample[what] for sample in after] or [np.nan]
            rows.append(
                (
                    f"{what}: least, most, growth",
                    f"{min(values):.0f}, {max(values):.0f}, {self.growth(what):+.1f}",
                )
            )
        load = np.median([sample["machine_load"] for sample in self.samples]) / os.cpu_count()
        rows.append(("load of the machine, of its cores (median)", f"{load:.1f}"))
        return [*rows, ("exit code", str(self.exit_code))]


def copy_of_bundled_organ(folder: Path) -> Path:
    """The bundled organ with another name and without its last structure, so that its answers have another size."""
    shutil.copytree(bundled_organ(), folder)
    path = folder / "organ.yaml"
    entries = yaml.safe_load(path.read_text())
    entries["name"], entries["structures"] = "Copy", entries["structures"][:-1]
    path.chmod(0o644)
    path.write_text(yaml.safe_dump(entries))
    return folder


def measure(process: int, at_s: float) -> dict:
    """Memory, threads and descriptors of a process."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    return {
        "at_s": at_s,
        "memory_mb": int(status["VmRSS"].split()[0]) / 1e3,
        "threads": int(status["Threads"]),
        "descriptors": len(os.listdir(f"/proc/{process}/fd")),
        "machine_load": os.getloadavg()[0],
    }


class Loads:
    """Asks for another organ whenever it is time."""

    def __init__(self, client: PlainClient, organs: list[Path], cache: Path, every_s: float):
        self._client, self._organs, self._cache, self._every_s = client, organs, cache, every_s
        self._service = client.node.create_client(LoadOrgan, f"{client.name}/load_organ")
        client.wait(self._service.service_is_ready, "service load_organ")
        self._pending, self._asked_s = None, time.monotonic()
        self._begin_s = self._asked_s
        self.done: list[dict] = []

    def go_on(self, now: float) -> None:
        """Note a load that has ended, or begin one."""
        if self._pending is not None:
            if self._pending[0].done():
                future, load = self._pending
                load |= {"took_s": now - self._asked_s, "result": future.result().result}
                self.done.append(load | {"message": future.result().message})
                self._pending = None
        elif now - self._asked_s >= self._every_s:
            number = len(self.done)
            fresh = number % FORGET_CACHE_EVERY == FORGET_CACHE_EVERY - 1
            for file in self._cache.rglob("*.npz") if fresh else ():
                file.unlink()
            folder = self._organs[(number + 1) % len(self._organs)]
            self._asked_s = now
            future = self._service.call_async(LoadOrgan.Request(folder=str(folder)))
            self._pending = future, {"asked_s": now - self._begin_s, "computed_anew": fresh}

    def open(self, least: int) -> bool:
        """Whether one is going on, or fewer than `least` are done."""
        return self._pending is not None or len(self.done) < least


def soak(plan: Plan, scratch: Path, show=lambda seconds, text: None) -> Soak:
    """Run it; `show` takes how many seconds have gone by, and a text."""
    organs = [bundled_organ(), copy_of_bundled_organ(scratch / "copy")]
    sizes = {organ.name: len(organ.structure_points) for organ in map(load_organ, organs)}
    result, heard, cache = Soak(plan), Heard(), scratch / "cache"
    parameters = {"organ_root": "['/']", "estimator": plan.estimator, "frame_budget_s": 60.0}
    with contextlib.ExitStack() as open_now:
        domain = open_now.enter_context(reserved())
        open_now.enter_context(_environment(XDG_CACHE_HOME=str(cache)))
        node = open_now.enter_context(NodeProcess(domain, scratch, parameters))
        client = open_now.enter_context(PlainClient(domain))
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        client.node.create_subscription(PointCloud2, "surface_points", heard.cloud, best_effort, raw=True)
        client.node.create_subscription(PointCloud2, f"{client.name}/deformed_points", heard.answer, 50)
        client.node.create_subscription(EstimatorStatus, f"{client.name}/status", heard.status, 50)
        node.wait_for_text("answering clouds", 120.0)
        loads = Loads(client, organs, cache, plan.load_every_s)
        report = scratch / "replay.json"
        with _replay(domain, plan.rate, report):
            client.wait(lambda: heard.answers_s, "first answer")
            begin_s = shown_s = time.monotonic()
            while (now := time.monotonic()) < begin_s + plan.seconds or loads.open(plan.least_loads):
                client.spin(0.02)
                loads.go_on(now)
                if now - shown_s >= SAMPLE_S:
                    result.samples.append(measure(node.process.pid, now - begin_s))
                    show(
                        min(now, begin_s + plan.seconds) - shown_s,
                        f"{len(heard.answers_s)} answers, {len(loads.done)} loads",
                    )
                    shown_s = now
        client.spin(1.5)  # the last answers
        result.sent = json.loads(report.read_text())["sent"]["/surface_points"]
        result.exit_code, result.traceback = node.stop(), "Traceback" in node.text
    _judge(result, heard, loads.done, sizes, begin_s)
    return result


def _judge(result: Soak, heard: Heard, loads: list[dict], sizes: dict[str, int], begin_s: float) -> None:
    last = heard.last
    result.loads = loads
    result.counts = {
        name: getattr(last, f"frames_{name}") for name in ("received", "answered", "dropped", "refused")
    }
    answers_s = np.array(heard.answers_s)
    gaps_s = np.diff(answers_s)
    result.gap_s = float(gaps_s.max())
    result.gaps = [
        {"at_s": float(answers_s[i] - begin_s), "took_s": float(gaps_s[i])}
        for i in np.argsort(gaps_s)[: -MOST_GAPS - 1 : -1]
    ]
    result.gap_of_clouds_s = float(np.diff(heard.clouds_s).max())
    percentiles = {"p50": 50, "p95": 95, "p99": 99, "max": 100}
    result.latency_ms = {n: 1e3 * float(np.percentile(heard.latencies_s, p)) for n, p in percentiles.items()}
    both = heard.size_of.keys() & heard.organ_of.keys()
    result.mislabelled = sum(sizes[heard.organ_of[stamp]] != heard.size_of[stamp] for stamp in both)
    result.labelled = {name: sum(heard.organ_of[s] == name for s in both) for name in sizes}
    result.labelled = {name: count for name, count in result.labelled.items() if count}


@contextlib.contextmanager
def _environment(**changes: str):
    saved = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@contextlib.contextmanager
def _replay(domain: int, rate: float, report: Path):
    command = [executable("replay"), bundled_bag(), "--rate", rate, "--loop", "--restamp"]
    command += ["--subscribers", 2, "--report", report]
    environment = os.environ | environment_of(domain)
    with subprocess.Popen([*map(str, command)], env=environment, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()
            process.wait(20.0)


def main() -> int:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=3.0, help="multiple of the bag's rate")
    parser.add_argument(
        "--load-every", type=float, default=20.0, metavar="S", help="time between two loads, s"
    )
    parser.add_argument("--estimator", default="elastic")
    parser.add_argument("--out", type=Path, default=Path("out/soak"))
    options = parser.parse_args()
    plan = Plan(60.0 * options.minutes, options.rate, options.load_every, options.estimator)
    print(f"soak of {plan.seconds:.0f} s; the node starts, which takes some seconds", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="soak_") as scratch,
        tqdm(total=round(plan.seconds), unit="s", desc="soak", file=sys.stderr) as bar,
    ):

        def show(seconds: float, text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(round(max(seconds, 0.0), 1))

        result = soak(plan, Path(scratch), show)
    options.out.mkdir(parents=True, exist_ok=True)
    growth = {what: result.growth(what) for what in MOST_GROWTH}
    wrong = result.wrong()
    (options.out / "soak.json").write_text(
        json.dumps(asdict(result) | {"growth": growth, "wrong": wrong}, indent=1)
    )
    for name, value in result.rows():
        print(f"{name:42} {value}")
    for sentence in wrong:
        print(f"wrong: {sentence}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
