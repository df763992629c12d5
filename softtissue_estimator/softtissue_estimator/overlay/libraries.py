"""The libraries of this room, which are an extra (`overlay`): OpenCV, and Numba that compiles the inner loops."""

import os
from collections.abc import Callable
from typing import Any

from softtissue_estimator.errors import MissingDependencyError

# Most pixels of an image that is decoded: a file of a few bytes may name a size that fills the memory.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

try:
    import cv2 as cv2
    import numba
except ImportError as error:
    raise MissingDependencyError(
        f"overlay: expected OpenCV and Numba, got no {error.name}; pip install opencv-python-headless numba,"
        " or softtissue_estimator with [overlay]"
    ) from error

# One thread: two cores are shared with the node, whose frames must not wait.
cv2.setNumThreads(1)


def compiled(signature: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function for one signature, in which it lets other threads run.

    What is compiled is kept beside the source or in the user's cache, where one of them can be written; else it is
    compiled anew by every process, which takes seconds.
    """

    def compile_function(function: Callable[..., Any]) -> Callable[..., Any]:
        done: Callable[..., Any]
        try:
            done = numba.njit(signature, nogil=True, cache=True, error_model="numpy")(function)
        except RuntimeError:  # Numba found no place that it may write to
            done = numba.njit(signature, nogil=True, error_model="numpy")(function)
        return done

    return compile_function


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let compiled functions take in the lines of another one instead of calling it, which costs nothing."""
    done: Callable[..., Any] = numba.njit(inline="always", nogil=True)(function)
    return done
