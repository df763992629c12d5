"""Pools of memory that the C library keeps for threads other than the first."""

from pathlib import Path

_POOL = 64 << 20  # HEAP_MAX_SIZE of glibc


def pools_of(process: int | str) -> int:
    """Count them in a process's map: each is reserved as a whole, and the first part of it made usable."""
    found, usable = 0, (0, 0)
    for line in Path(f"/proc/{process}/maps").read_text().splitlines():
        place, rights, *rest = line.split()
        begin, end = (int(number, 16) for number in place.split("-"))
        anonymous = len(rest) == 3
        if rights == "---p" and anonymous and usable[1] == begin and end % _POOL == usable[0] % _POOL == 0:
            found += end - usable[0] == _POOL
        usable = (begin, end) if rights == "rw-p" and anonymous else (0, 0)
    return found
