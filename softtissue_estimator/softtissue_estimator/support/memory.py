"""Give memory that is free back to the system."""

import ctypes
import sys


def give_back() -> None:
    """Let the allocator return what large things have left; it would keep it for later, in pieces that grow in number.

    Does nothing where the C library has no such call.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
