"""Match clouds with the correspondences of the same stamp, whichever comes first. Knows no ROS."""

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Generic, TypeVar

CloudT = TypeVar("CloudT")
PairsT = TypeVar("PairsT")


@dataclass(frozen=True)
class Waiting(Generic[CloudT]):
    """A cloud and when it was received, s on a monotonic clock."""

    cloud: CloudT
    received_s: float


@dataclass(frozen=True)
class Outcome(Generic[CloudT, PairsT]):
    """What became of the clouds that waited.

    Attributes
    ----------
    matched : tuple or None
        A cloud (with its time of reception) and the correspondences of its stamp.
    passed_over : list
        Clouds older than the matched one: a newer one came first.
    unmatched : list
        Clouds whose place or patience is exhausted.
    """

    matched: tuple[Waiting[CloudT], PairsT] | None = None
    passed_over: list[Waiting[CloudT]] = field(default_factory=list)
    unmatched: list[Waiting[CloudT]] = field(default_factory=list)


class StampMatcher(Generic[CloudT, PairsT]):
    """Small buffers of clouds and correspondences that wait for each other.

    Parameters
    ----------
    capacity : int
        Most clouds, and most correspondences, that wait.
    patience_s : float
        How long a cloud waits, s.
    """

    def __init__(self, capacity: int = 4, patience_s: float = 0.5) -> None:
        self._capacity = capacity
        self._patience_s = patience_s
        self._clouds: OrderedDict[int, Waiting[CloudT]] = OrderedDict()
        self._pairs: OrderedDict[int, PairsT] = OrderedDict()

    @property
    def waiting(self) -> int:
        """Number of clouds that wait."""
        return len(self._clouds)

    def add_cloud(self, stamp_ns: int, cloud: CloudT, now_s: float) -> Outcome[CloudT, PairsT]:
        """Take a cloud that was received at `now_s` (monotonic clock, s)."""
        entry = Waiting(cloud, now_s)
        # A repeated stamp is ambiguous: the newer cloud takes the place of the one that waited.
        repeated = self._clouds.pop(stamp_ns, None)
        passed_over = [] if repeated is None else [repeated]
        if stamp_ns in self._pairs:
            return Outcome((entry, self._pairs.pop(stamp_ns)), passed_over + self._take_older(stamp_ns))
        self._clouds[stamp_ns] = entry
        unmatched = []
        while len(self._clouds) > self._capacity:
            unmatched.append(self._clouds.popitem(last=False)[1])
        return Outcome(None, passed_over, unmatched)

    def add_pairs(self, stamp_ns: int, pairs: PairsT) -> Outcome[CloudT, PairsT]:
        """Take correspondences."""
        if stamp_ns in self._clouds:
            entry = self._clouds.pop(stamp_ns)
            return Outcome((entry, pairs), self._take_older(stamp_ns))
        self._pairs[stamp_ns] = pairs
        while len(self._pairs) > self._capacity:
            self._pairs.popitem(last=False)
        return Outcome()

    def pass_over(self, stamp_ns: int) -> Outcome[CloudT, PairsT]:
        """Give up on clouds that are older than one that goes on without correspondences."""
        return Outcome(passed_over=self._take_older(stamp_ns))

    def expire(self, now_s: float) -> Outcome[CloudT, PairsT]:
        """Give up on clouds that have waited longer than the patience allows."""
        late = [stamp for stamp, entry in self._clouds.items() if now_s - entry.received_s > self._patience_s]
        return Outcome(unmatched=[self._clouds.pop(stamp) for stamp in late])

    def clear(self) -> list[Waiting[CloudT]]:
        """Forget everything and return the clouds that waited."""
        clouds = list(self._clouds.values())
        self._clouds.clear()
        self._pairs.clear()
        return clouds

    def _take_older(self, stamp_ns: int) -> list[Waiting[CloudT]]:
        older = [stamp for stamp in self._clouds if stamp < stamp_ns]
        return [self._clouds.pop(stamp) for stamp in older]
