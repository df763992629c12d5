"""Damage files and messages by seed and see that the product bears all of them.

As a program: `make fuzz` (COUNT=100000 SEED=0), or `make fuzz REPLAY=out/fuzz/FILE` for one that it did not bear. What
was begun is continued. Exit code 1 after a failure.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

if __name__ == "__main__":
    root = Path(__file__).parents[2]
    sys.path[:0] = [str(root / part) for part in ("tests", "scripts", "training", "softtissue_estimator")]

from fuzz.kind import Failure, Kind, MissingError, try_input
from fuzz.kinds import KINDS, inputs_of, kind_called
from fuzz.worker import Progress, run_apart

_MOST_FAILURES = 50  # of a kind, after which it is left


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign that the command line describes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--count", type=int, default=100_000, help="damaged files and messages (default: 100000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--kind", action="append", choices=[k.name.replace(" ", "_") for k in KINDS], help="this alone"
    )
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="for failures and progress")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="a file that was not borne")
    options = parser.parse_args(arguments)
    if options.replay is not None:
        return replay(options.replay)
    options.out.mkdir(parents=True, exist_ok=True)
    kinds = [kind_called(name) for name in options.kind] if options.kind else list(KINDS)
    return Campaign(options.out, options.seed, options.count).run(kinds)


class Campaign:
    """So many inputs of a seed.

    Parameters
    ----------
    out : Path
        Keeps `progress.json` and the inputs that were not borne.
    seed, count : int
    """

    def __init__(self, out: Path, seed: int, count: int) -> None:
        self._out, self._seed, self._count = out, seed, count
        self._file = out / "progress.json"
        self._kinds: dict[str, dict] = {}
        begun = json.loads(self._file.read_text()) if self._file.exists() else {}
        if (begun.get("seed"), begun.get("count"), begun.get("complete")) == (seed, count, False):
            self._kinds = begun["kinds"]
            print("==> Continuing what was begun", flush=True)

    def run(self, kinds: list[type[Kind]]) -> int:
        """Try all inputs of these kinds; return the exit code."""
        for kind in kinds:
            state = self._kinds.setdefault(
                kind.name, {"done": 0, "outcomes": {}, "failures": [], "seconds": 0.0}
            )
            try:
                self._run_kind(kind, state)
            except MissingError as missing:
                state["skipped"] = str(missing)
                print(f"{kind.name}: left out, {missing}", flush=True)
        self._save(complete=True)
        print(self._summary(kinds), flush=True)
        failed = any(self._kinds[kind.name]["failures"] for kind in kinds)
        return 1 if failed else 0

    def _run_kind(self, kind: type[Kind], state: dict) -> None:
        count = inputs_of(kind, self._count)
        said = 0.0

        def note(progress: Progress) -> bool:
            nonlocal said
            state["done"] = progress.done
            state["outcomes"] = dict(Counter(state["outcomes"]) + progress.outcomes)
            state["seconds"] += progress.seconds
            for failure in progress.failures:
                file = self._keep(failure)
                state["failures"].append(file.name)
                print(
                    f"\n{kind.name}, input {failure.index}: not borne, {file}\n{failure.why[-3000:]}",
                    flush=True,
                )
            self._save(complete=False)
            if time.monotonic() - said > 5.0 or progress.done == count:
                said = time.monotonic()
                per_second = state["done"] * kind.each / max(state["seconds"], 1e-9)
                print(
                    f"{kind.name}: {progress.done * kind.each} of {count * kind.each}, {per_second:.0f} a second,"
                    f" {len(state['failures'])} not borne",
                    flush=True,
                )
            return len(state["failures"]) < _MOST_FAILURES

        run_apart(kind, self._seed, range(state["done"], count), note)

    def _keep(self, failure: Failure) -> Path:
        file = self._out / f"{failure.kind.replace(' ', '_')}-{self._seed}-{failure.index}-{failure.name}"
        file.write_bytes(failure.content)
        replay_it = f"make fuzz REPLAY={file}\nseed {self._seed}, input {failure.index} of {failure.kind}\n\n"
        file.with_name(file.name + ".why").write_text(replay_it + failure.why, errors="backslashreplace")
        return file

    def _save(self, complete: bool) -> None:
        state = {"seed": self._seed, "count": self._count, "complete": complete, "kinds": self._kinds}
        part = self._file.with_suffix(".part")
        part.write_text(json.dumps(state, indent=1))
        part.replace(self._file)

    def _summary(self, kinds: list[type[Kind]]) -> str:
        lines = [f"{'kind':16} {'inputs':>8} {'not borne':>10} {'s':>7}  what became of them"]
        total = wrong = 0
        for kind in kinds:
            state = self._kinds[kind.name]
            outcomes = ", ".join(
                f"{name} {n}" for name, n in sorted(state["outcomes"].items(), key=lambda o: -o[1])
            )
            inputs, failures = state["done"] * kind.each, len(state["failures"])
            total, wrong = total + inputs, wrong + failures
            what = state.get("skipped") or outcomes
            lines.append(f"{kind.name:16} {inputs:8} {failures:10} {state['seconds']:7.0f}  {what}")
        seconds = sum(self._kinds[kind.name]["seconds"] for kind in kinds)
        lines.append(f"{'all':16} {total:8} {wrong:10} {seconds:7.0f}  seed {self._seed}")
        return "\n".join(lines)


def replay(file: Path) -> int:
    """Try an input that was kept once more; return the exit code."""
    kind_name, _, rest = file.name.partition("-")
    name = rest.split("-", 2)[2]
    with tempfile.TemporaryDirectory(prefix="fuzz_") as folder:
        kind = kind_called(kind_name)(Path(folder))
        try:
            outcome, why = try_input(kind, name, file.read_bytes())
            if not why:
                kind.check_good()
        finally:
            kind.close()
    print(f"{file}: {outcome}\n{why}" if why else f"{file}: {outcome}")
    return 1 if why else 0


if __name__ == "__main__":
    sys.exit(main())
