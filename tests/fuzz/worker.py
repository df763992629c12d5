"""A process that tries inputs of a kind, and one that watches it: whatever it does, the next input is tried."""

import contextlib
import multiprocessing
import os
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzz.kind import BATCH, Failure, Kind, MissingError, try_inputs

_LONGEST_S = 90.0  # on the clock, for one input: readers apart have 60
_STARTS_WITHIN_S = 180.0
_MOST_MEMORY_BYTES = 4 << 30  # of the process, resident
_MOST_ADDRESSES_BYTES = 24 << 30


@dataclass
class Progress:
    """What became of the inputs since the last time; `done` are all up to now."""

    done: int
    outcomes: Counter = field(default_factory=Counter)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0


def run_apart(kind: type[Kind], seed: int, indices: range, note: Callable[[Progress], bool]) -> None:
    """Try inputs in a process of its own, in a new one after each that ends or hangs it.

    Parameters
    ----------
    note : callable
        Takes what became of some more; returns whether to go on.

    Raises
    ------
    MissingError
        The kind needs what is not there.
    """
    at = indices.start
    while at < indices.stop:
        with tempfile.TemporaryDirectory(prefix="fuzz_") as folder:
            at, go_on = _Watch(kind, seed, range(at, indices.stop), Path(folder)).run(note)
        if not go_on:
            return


class _Watch:
    def __init__(self, kind: type[Kind], seed: int, indices: range, folder: Path) -> None:
        self._kind, self._seed, self._indices, self._folder = kind, seed, indices, folder
        spawn = multiprocessing.get_context("spawn")
        self._heard, self._told = spawn.Pipe(duplex=False)
        self._at = spawn.Value("q", -1)
        self._process = spawn.Process(
            target=_work, args=(kind, seed, indices, str(folder), self._told, self._at), daemon=False
        )

    def run(self, note: Callable[[Progress], bool]) -> tuple[int, bool]:
        """Return the number of the next input, and whether to go on."""
        self._process.start()
        self._told.close()
        at, since, done = -1, time.monotonic(), self._indices.start
        try:
            while True:
                heard = self._hear()
                if isinstance(heard, MissingError):
                    raise heard
                if heard is not None:
                    done = heard.done
                    if not note(heard):
                        return done, False
                    if done == self._indices.stop:
                        self._process.join(60.0)
                        return done, True
                    continue
                if self._at.value != at:
                    at, since = self._at.value, time.monotonic()
                why = self._trouble(time.monotonic() - since, at)
                if why and at < 0:
                    raise RuntimeError(
                        f"{self._kind.name}: expected a process that begins, got one where {why}"
                    )
                if why:
                    index = max(self._at.value, done)
                    name, content = self._at_work()
                    failure = Failure(self._kind.name, index, name, content, why)
                    return index + 1, note(Progress(index + 1, Counter(failed=1), [failure]))
        finally:
            if self._process.is_alive():
                self._process.kill()
            self._process.join()

    def _hear(self) -> Any:
        try:
            return self._heard.recv() if self._heard.poll(0.2) else None
        except EOFError:
            self._process.join(10.0)
            return None

    def _trouble(self, waited_s: float, at: int) -> str:
        if not self._process.is_alive():
            return f"the process ended with code {self._process.exitcode}"
        if waited_s > (_STARTS_WITHIN_S if at < 0 else _LONGEST_S):
            return f"not done after {waited_s:.0f} s"
        with contextlib.suppress(OSError, StopIteration):
            lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
            used = int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) << 10
            if used > _MOST_MEMORY_BYTES:
                return f"the process has {used >> 20} MiB of memory"
        return ""

    def _at_work(self) -> tuple[str, bytes]:
        try:
            name, content = (self._folder / "at_work").read_bytes().split(b"\n", 1)
            return name.decode(), content
        except (OSError, ValueError):
            return "nothing", b""


def _work(kind_type: type[Kind], seed: int, indices: range, folder: str, told: Any, at: Any) -> None:
    os.environ["XDG_CACHE_HOME"] = str(Path(tempfile.gettempdir()) / f"fuzz_cache_{os.getuid()}")
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    place = Path(folder)
    (place / "kind").mkdir()
    try:
        kind = kind_type(place / "kind")
    except MissingError as missing:
        told.send(missing)
        return
    # Whatever the process does, its watcher finds the input that it did it with.
    make = kind.make

    def noted(rng: Any) -> tuple[str, bytes]:
        name, content = make(rng)
        (place / "at_work").write_bytes(name.encode() + b"\n" + content)
        return name, content

    kind.make = noted  # type: ignore[method-assign]
    began, progress = time.monotonic(), Progress(indices.start)
    tried = try_inputs(kind, seed, indices)
    for index in indices:
        at.value = index
        _, outcome, failure = next(tried)
        progress.done = index + 1
        progress.outcomes[outcome] += 1
        if failure is not None:
            progress.failures.append(failure)
        if (
            failure is not None
            or index % BATCH == BATCH - 1
            or index == indices[-1]
            or time.monotonic() - began > 5.0
        ):
            progress.seconds, began = time.monotonic() - began, time.monotonic()
            told.send(progress)
            progress = Progress(index + 1)
    kind.close()
