"""Pass on what the core logs."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from softtissue_estimator.support.sentences import one_sentence

_LOGGER = "softtissue_estimator"


class _Teller(logging.Handler):
    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        warning = "warning: " if record.levelno >= logging.WARNING else ""
        self._tell(one_sentence(warning + record.getMessage()))


@contextmanager
def log_lines(tell: Callable[[str], None]) -> Iterator[None]:
    """Pass every message and warning of the core to `tell` while the block runs, whatever logging is set to."""
    logger, teller = logging.getLogger(_LOGGER), _Teller(tell)
    previous = logger.level
    logger.addHandler(teller)
    logger.setLevel(min(logging.INFO, logger.getEffectiveLevel()))
    try:
        yield
    finally:
        logger.removeHandler(teller)
        logger.setLevel(previous)
