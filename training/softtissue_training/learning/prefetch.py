"""Work that is done ahead in threads, its results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Place = TypeVar("_Place")
_Result = TypeVar("_Result")


def prefetched(
    work: Callable[[_Place], _Result], places: Iterator[_Place], threads: int
) -> Generator[_Result, None, None]:
    """Yield `work` of every place in order, `threads` of them ahead."""
    with ThreadPoolExecutor(threads) as pool:
        coming: deque[Future[_Result]] = deque()
        for place in places:
            coming.append(pool.submit(work, place))
            if len(coming) > threads:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()
