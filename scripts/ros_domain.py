"""Run a command in a ROS domain that nobody else on this machine uses: scripts/ros_domain.py COMMAND [ARGUMENT ...].

The tests take theirs with `reserve`. Needs nothing but Python.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

DOMAIN, RANGE = "ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Domain 0 is everybody's; the ports of those above 100 are among those that Linux gives to any program (from 32768).
DOMAINS = range(1, 101)
_NAME = "softtissue-ros-domain"
_FIRST_PORT, _PORTS_A_DOMAIN = 7400, 250
# Of the domain, and of the first eight programs in it.
_LISTENING = (0, *range(10, 26))

_SHARED_MEMORY = Path("/dev/shm")
_PORT_FILE = re.compile(r"(?:sem\.)?fastdds_port(\d+)(?:_el|_mutex)?")

_turn = itertools.count(7 * os.getpid())


class Reservation:
    """A domain that is ours until `release`, or until the process ends.

    What is held is a name among the abstract sockets of Linux, of which there is one for each network, as of the
    domain's ports. The system frees it at the end of the process, however that comes.
    """

    def __init__(self, domain: int, name: socket.socket):
        self.domain = domain
        self._name = name

    def release(self) -> None:
        """Let others have the domain."""
        self._name.close()

    def give_to_children(self) -> None:
        """Hold the domain also for the program that replaces this one, and for what that one starts."""
        self._name.set_inheritable(True)


def reserve() -> Reservation:
    """Reserve a domain in which no program is and which nobody else has reserved.

    They are taken in turn, so that one just released rests.

    Raises
    ------
    RuntimeError
        If none is free.
    """
    for _ in DOMAINS:
        domain = DOMAINS[next(_turn) % len(DOMAINS)]
        name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        with contextlib.suppress(OSError):
            name.bind(f"\0{_NAME}-{domain}")
            if not _in_use(domain):
                _remove_leftovers(domain)
                return Reservation(domain, name)
        name.close()
    raise RuntimeError(f"expected a free ROS domain from {DOMAINS[0]} to {DOMAINS[-1]}, got none")


@contextlib.contextmanager
def reserved() -> Iterator[int]:
    """Reserve a domain within a block."""
    reservation = reserve()
    try:
        yield reservation.domain
    finally:
        reservation.release()


def environment_of(domain: int) -> dict[str, str]:
    """Return the variables that bring a program into a domain, and keep it on this machine."""
    return {DOMAIN: str(domain), RANGE: "LOCALHOST"}


def _in_use(domain: int) -> bool:
    """Tell whether a program that has reserved nothing is in the domain: its ports cannot be had."""
    for port in _LISTENING:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            try:
                listener.bind(("", _FIRST_PORT + _PORTS_A_DOMAIN * domain + port))
            except OSError:
                return True
    return False


def _remove_leftovers(domain: int) -> None:
    """Remove the ports in shared memory that killed programs left in a domain: the next one there would open them."""
    ports = range(_FIRST_PORT + _PORTS_A_DOMAIN * domain, _FIRST_PORT + _PORTS_A_DOMAIN * (domain + 1))
    with contextlib.suppress(OSError):
        for file in _SHARED_MEMORY.iterdir():
            found = _PORT_FILE.fullmatch(file.name)
            if found and int(found[1]) in ports:
                file.unlink(missing_ok=True)


def main(command: list[str]) -> None:
    """Become the command, in a domain of its own unless `ROS_DOMAIN_ID` names one already."""
    if not os.environ.get(DOMAIN):
        reservation = reserve()
        reservation.give_to_children()
        os.environ[DOMAIN] = str(reservation.domain)
    if not os.environ.get(RANGE):
        os.environ[RANGE] = "LOCALHOST"
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(f"error: expected a command, got {command[0]!r}: {error.strerror}")


if __name__ == "__main__":
    main(sys.argv[1:])
