"""Send pairs of signals to a node at random moments, and say what it left behind.

As a program: `scripts/run python tests/integration/signal_pairs.py 200` tries as many pairs, each on a node of its own,
and exits with 1 if any ended otherwise than with exit code 0, within 3 s and without a trace.
"""

import argparse
import os
import random
import re
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

from softtissue_msgs.srv import LoadOrgan

from integration.harness import NodeProcess, PlainClient, write_organ
from ros_domain import reserved

LONGEST_S = 3.0
LOADING_SHARE = 0.7  # of the longest time before a signal: about what a load takes
_SEGMENT = re.compile(r"/dev/shm/fastdds_(?!port)\w+$")


@dataclass(frozen=True)
class Ending:
    """How a node ended after a pair of signals, `after_s` after its handlers were in place, `gap_s` apart."""

    after_s: float
    gap_s: float
    exit_code: int
    took_s: float
    left: tuple[str, ...]
    log: str

    @property
    def as_wanted(self) -> bool:
        return (
            self.exit_code == 0 and self.took_s < LONGEST_S and not self.left and "Traceback" not in self.log
        )


def children(process: int) -> set[int]:
    """Numbers of the processes that a process has started, and theirs."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == process:
            found |= {int(folder.name)} | children(int(folder.name))
    return found


def shared_memory(process: int) -> set[str]:
    """Segments of shared memory that a process uses.

    Not the files of Fast DDS's ports: those of one that is gone stay now and then, and the next one takes them over.
    """
    try:
        lines = Path(f"/proc/{process}/maps").read_text().splitlines()
    except OSError:
        return set()
    return {line.split()[-1] for line in lines if _SEGMENT.search(line)}


def running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def try_pair(
    domain: int, folder: Path, organ: Path, cache: Path, rng: random.Random, loading: bool = False
) -> Ending:
    """Start a node, send it two signals at random moments, while it loads an organ by service say; what is left?"""
    scratch = folder / "tmp"
    scratch.mkdir(parents=True)
    after_s, gap_s = rng.uniform(0.0, 9.0), rng.choice([0.0, rng.uniform(0.0, 0.01), rng.uniform(0.0, 1.5)])
    environment = {"TMPDIR": str(scratch), "XDG_CACHE_HOME": str(cache), "HOME": str(folder)}
    saved = {name: os.environ.get(name) for name in environment}
    os.environ.update(environment)
    try:
        node = NodeProcess(domain, folder, {"organ": organ})
    finally:
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    with node:
        wait_for_handlers(node)
        if loading:
            load_by_service(domain, node, organ, cache)
            after_s *= LOADING_SHARE
        time.sleep(after_s)
        started, segments = children(node.process.pid), shared_memory(node.process.pid)
        began = time.monotonic()
        for number, wait_s in ((rng.choice([signal.SIGINT, signal.SIGTERM]), gap_s), (signal.SIGINT, 0.0)):
            if node.process.poll() is None:
                os.kill(node.process.pid, number)
            time.sleep(wait_s)
        code = node.wait(30.0)
        took_s = time.monotonic() - began
        time.sleep(0.1)
        left = [f"process {number}" for number in started if running(number)]
        left += [str(path) for path in scratch.iterdir()] + [str(path) for path in cache.rglob("*.part")]
        left += [segment for segment in segments if Path(segment).exists()]
        return Ending(after_s, gap_s, code, took_s, tuple(left), node.text)


def load_by_service(domain: int, node: NodeProcess, organ: Path, cache: Path):
    """Have the node load an organ whose results are not cached; wait for the process that prepares it."""
    node.wait_for_text("answering clouds")
    for file in cache.rglob("*.npz"):
        file.unlink()
    with PlainClient(domain) as client:
        service = client.node.create_client(LoadOrgan, f"{client.name}/load_organ")
        client.wait(service.service_is_ready, "service load_organ")
        service.call_async(LoadOrgan.Request(folder=str(organ)))
        client.wait(lambda: children(node.process.pid), "process that prepares the organ")


def wait_for_handlers(node: NodeProcess) -> None:
    """Wait until the process catches SIGINT and SIGTERM itself: before that Python is not at work yet."""
    wanted = (1 << (signal.SIGINT - 1)) | (1 << (signal.SIGTERM - 1))
    while node.process.poll() is None:
        status = Path(f"/proc/{node.process.pid}/status").read_text()
        caught = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt"))
        if caught & wanted == wanted:
            return
        time.sleep(0.001)


def try_pairs(count: int, folder: Path, seed: int):
    """Yield how `count` nodes ended; the organ's cache is emptied now and then, so that some are loading."""
    rng = random.Random(seed)
    organ, cache = write_organ(folder / "organ"), folder / "cache"
    cache.mkdir()
    for number in range(count):
        for file in cache.rglob("*.npz") if rng.random() < 0.6 else ():
            file.unlink()
        with reserved() as domain:
            yield try_pair(domain, folder / f"node{number}", organ, cache, rng, rng.random() < 0.4)


def main() -> int:
    """Try as many pairs as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", type=int)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    wrong, longest_s = 0, 0.0
    with tempfile.TemporaryDirectory(prefix="signal_pairs_") as folder:
        for number, ending in enumerate(try_pairs(options.pairs, Path(folder), options.seed)):
            longest_s = max(longest_s, ending.took_s)
            if not ending.as_wanted:
                wrong += 1
                print(f"pair {number}: {ending}", flush=True)
    print(f"{options.pairs} pairs of signals: {wrong} ended wrongly, the longest took {longest_s:.2f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
