"""The boundary round every callback and thread of the node: what is raised behind it becomes a sentence."""

import inspect
import threading
import time
import traceback
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.throttle import Throttle
from softtissue_estimator.support.sentences import one_sentence

ResultT = TypeVar("ResultT")

LOG_PERIOD_S = 5.0
_MOST_TRACES = 256  # places in the code that are remembered
_BROKEN_S = 10.0  # after which errors of the middleware, and nothing but errors, mean that it is broken


class Boundary:
    """Turns what nobody expected into a sentence, counts it and lets the node live on; methods of any thread.

    Parameters
    ----------
    log : logger of rclpy
    on_fatal : callable
        Takes the errors after which the process cannot go on.
    """

    def __init__(self, log: Any, on_fatal: Callable[[BaseException], None]) -> None:
        self._log, self._on_fatal = log, on_fatal
        self._lock = threading.Lock()
        self._throttle = Throttle(LOG_PERIOD_S)
        self._traced: set[tuple[str, str]] = set()
        self._faults = 0
        self._alive_s = time.monotonic()

    @property
    def faults(self) -> int:
        """How often something was raised that nobody expected."""
        with self._lock:
            return self._faults

    def info(self, text: str) -> None:
        """Log a sentence."""
        self._log.info(one_sentence(text))

    def warn(self, text: str) -> None:
        """Log a warning, the same one only so often."""
        if self._throttle.due(text, time.monotonic()):
            self._log.warning(one_sentence(text))

    def error(self, text: str) -> None:
        """Log an error, the same one only so often."""
        if self._throttle.due(text, time.monotonic()):
            self._log.error(one_sentence(text))

    def sentence(self, where: str, error: BaseException) -> str:
        """Say in a sentence what was raised; what nobody expected is counted and logged.

        The sentence names the kind of an unexpected error alone: its words may hold what a file or message contains.

        Parameters
        ----------
        where : str
            What was being done.
        """
        said = self.words(error, where)
        if isinstance(error, SoftTissueError):
            return said
        frames = traceback.extract_tb(error.__traceback__)
        place = (type(error).__name__, f"{frames[-1].filename}:{frames[-1].lineno}" if frames else where)
        with self._lock:
            self._faults += 1
            new = place not in self._traced and len(self._traced) < _MOST_TRACES
            if new:
                self._traced.add(place)
        if self._throttle.due(said, time.monotonic()):
            self._log.error(said)
        if new:
            lines = "".join(traceback.format_exception(error)).splitlines()
            self._log.debug("\n".join(one_sentence(line) for line in lines))
        if is_fatal(error):
            self._on_fatal(error)
        return said

    @staticmethod
    def words(error: BaseException, where: str = "transition") -> str:
        """Return the sentence about an error; nothing is counted or logged."""
        if isinstance(error, SoftTissueError):
            return one_sentence(str(error))
        return one_sentence(f"{where}: expected no error of the program itself, got {type(error).__name__}")

    def guarded(
        self,
        where: str,
        callback: Callable[..., Any],
        failed: Callable[[str, tuple[Any, ...]], Any] = lambda _said, _arguments: None,
    ) -> Callable[..., Any]:
        """Return a callback that raises nothing.

        Parameters
        ----------
        where : str
            Whose callback it is.
        callback : callable
            A function or a coroutine function.
        failed : callable
            Makes the result from a sentence and the callback's arguments where something was raised.
        """
        if inspect.iscoroutinefunction(callback):

            @wraps(callback)
            async def awaited(*arguments: Any) -> Any:
                try:
                    result = await callback(*arguments)
                except Exception as error:
                    return failed(self.sentence(where, error), arguments)
                self.alive()
                return result

            return awaited

        @wraps(callback)
        def called(*arguments: Any) -> Any:
            try:
                result = callback(*arguments)
            except Exception as error:
                return failed(self.sentence(where, error), arguments)
            self.alive()
            return result

        return called

    def middleware_goes_on(self, error: Exception) -> bool:
        """Say whether to go on after the executor itself raised an error, while callbacks still run now and then."""
        self.sentence("executor", error)
        return not is_fatal(error) and time.monotonic() - self._alive_s < _BROKEN_S

    def alive(self) -> None:
        """Note that the executor begins or goes on."""
        self._alive_s = time.monotonic()


def is_fatal(error: BaseException) -> bool:
    """Say whether the process itself is at its end.

    NumPy's refusal to make a single array of absurd size takes no memory: it is a mistake of whoever asked for it.
    """
    return type(error) is MemoryError or not isinstance(error, Exception)
