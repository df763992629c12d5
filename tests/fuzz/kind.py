"""What a kind of damaged input is, and how one of them is tried: the rules that hold for all kinds."""

import contextlib
import gc
import random
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.support.log_lines import log_lines

LONGEST_SENTENCE = 300
MOST_SECONDS = 5.0  # of the processor, for one input of at most a megabyte
MOST_BYTES = 400 << 20  # of memory beside what is in use before
BATCH = 200  # inputs, after which a good one must be read or answered rightly


class FailedError(AssertionError):
    """The product did with an input what it must not do."""


class MissingError(Exception):
    """What a kind needs is not there."""


@dataclass(frozen=True)
class Failure:
    """An input that was not borne, and why."""

    kind: str
    index: int
    name: str
    content: bytes
    why: str


class Kind:
    """A kind of input: makes damaged ones by seed and tries them.

    Parameters
    ----------
    folder : Path
        Empty; for templates and the input at work.

    Attributes
    ----------
    name : str
    share : int
        Of a hundred inputs.
    each : int
        Messages in one input.
    """

    name = ""
    share = 1
    each = 1

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        """Return the name and the content of a damaged input."""
        raise NotImplementedError

    def run(self, name: str, content: bytes) -> str:
        """Try an input; return in a word what became of it, or raise SoftTissueError where it is refused.

        Raises
        ------
        FailedError
            The product is at fault, as after any other exception but SoftTissueError.
        """
        raise NotImplementedError

    def check_good(self) -> None:
        """Raise FailedError unless an undamaged input is read or answered rightly."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of everything."""


def make_input(kind: Kind, seed: int, index: int) -> tuple[str, bytes]:
    """Return the input of that number: the same one every time."""
    return kind.make(random.Random(f"{seed} {kind.name} {index}"))


def try_input(kind: Kind, name: str, content: bytes) -> tuple[str, str]:
    """Return what became of an input, in a word, and why it is a failure; empty if it is none."""
    lines: list[str] = []
    _forget_peak()
    before, began = _memory("VmRSS"), time.process_time()
    try:
        with log_lines(lines.append), warnings.catch_warnings():
            warnings.simplefilter("error")  # nobody asked for lines on the terminal
            outcome = kind.run(name, content)
        for line in lines:
            check_sentence(line)
    except SoftTissueError as error:
        outcome = "refused"
        with _as_failure() as why:
            check_sentence(str(error))
        if why:
            return "failed", why[0]
    except FailedError as error:
        return "failed", str(error)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also what a library raises that is no Exception
        return "failed", "".join(traceback.format_exception(error))
    seconds, taken = time.process_time() - began, _memory("VmHWM") - before
    if seconds > MOST_SECONDS:
        return "failed", f"took {seconds:.1f} s of the processor; at most {MOST_SECONDS:g} s"
    if taken > MOST_BYTES:
        gc.collect()
        return "failed", f"took {taken >> 20} MiB of memory; at most {MOST_BYTES >> 20} MiB"
    return outcome, ""


def try_inputs(kind: Kind, seed: int, indices: range) -> Iterator[tuple[int, str, Failure | None]]:
    """Try inputs of these numbers and a good one after each batch; yield number, outcome and failure of each."""
    for index in indices:
        name, content = make_input(kind, seed, index)
        outcome, why = try_input(kind, name, content)
        failure = Failure(kind.name, index, name, content, why) if why else None
        if index % BATCH == BATCH - 1 or index == indices[-1]:
            with _as_failure() as wrong:
                kind.check_good()
            if wrong and failure is None:
                outcome, failure = (
                    "failed",
                    Failure(kind.name, index, name, content, f"afterwards: {wrong[0]}"),
                )
        yield index, outcome, failure


def check_sentence(text: str) -> None:
    """Raise FailedError unless a text is one line that can be printed, and not too long."""
    if not text or not text.isprintable() or len(text) > LONGEST_SENTENCE:
        raise FailedError(
            f"expected a printable line of 1 to {LONGEST_SENTENCE} characters, got {text[:2000]!r}"
        )


def expect(holds: bool, what: str) -> None:
    """Raise FailedError unless something holds."""
    if not holds:
        raise FailedError(what)


@contextlib.contextmanager
def _as_failure() -> Iterator[list[str]]:
    """Collect why the block failed."""
    why: list[str] = []
    try:
        yield why
    except FailedError as error:
        why.append(str(error))
    except Exception as error:
        why.append("".join(traceback.format_exception(error)))


def _forget_peak() -> None:
    # Sets the peak of memory to what is in use now (man 5 proc).
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _memory(what: str) -> int:
    """Bytes of resident memory: VmRSS now, VmHWM at most; 0 where nobody tells."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith(what)).split()[1]) << 10
    return 0
