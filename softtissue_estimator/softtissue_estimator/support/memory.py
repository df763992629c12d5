"""Memory that is free: one pool of it for all threads, and back to the system what large things have left."""

import ctypes
import sys
import time
import weakref
from typing import Any

_M_ARENA_MAX = -8  # of glibc's malloc.h
_LOOK_S = 0.02


def one_pool() -> None:
    """Let all threads take memory from one pool; call before any other thread is started.

    By default the C library keeps several, and what is freed in one serves no thread that takes from another. Where an
    organ takes the place of another again and again, more lies about free than is in use.

    Does nothing where the C library has no such setting.
    """
    _call("mallopt", _M_ARENA_MAX, 1)


def give_back() -> None:
    """Let the allocator return what large things have left; it would keep it for later, in pieces that grow in number.

    Does nothing where the C library has no such call.
    """
    _call("malloc_trim", 0)


def gone(thing: weakref.ref[Any], within_s: float) -> bool:
    """Wait until nothing refers to a thing any more, for a time at most, s; return whether nothing does."""
    end_s = time.monotonic() + within_s
    while thing() is not None:
        if time.monotonic() > end_s:
            return False
        time.sleep(_LOOK_S)
    return True


def _call(name: str, *arguments: int) -> None:
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*arguments)
