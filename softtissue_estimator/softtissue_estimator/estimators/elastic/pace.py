"""How long the thread's steps take on this machine, over what they are given."""

_MOST = 4.0
_RECOVERY = 0.98  # a step that was ready in time: the machine may have become less busy


class Pace:
    """Learns, from steps that were not ready when a frame came for them, when frames should come for the next ones.

    A frame that waits for a step in vain is late for nothing. So no other one waits for that step, and those after it
    are given as long as it took; from then on a little less each time. While frames have patience enough nothing is
    learnt: what is taken over does not depend on the machine.
    """

    def __init__(self) -> None:
        self._share, self._late = 1.0, False

    @property
    def share(self) -> float:
        """What steps are given, over what they are given on a machine that is fast enough; at least 1."""
        return self._share

    @property
    def late(self) -> bool:
        """Whether a frame has waited in vain for the step that is being made."""
        return self._late

    def waited_in_vain(self) -> None:
        """Note that the step was not ready for a frame that waited for it as long as it may."""
        self._late = True

    def given_up(self) -> None:
        """Note that nobody wants the step any more."""
        self._late = False

    def taken_over(self, share: float) -> None:
        """Note that a frame took a step over; `share` is how long it had been given until then, over 1."""
        if self._late:
            self._share = min(max(share, self._share), _MOST)
        else:
            self._share = max(1.0, _RECOVERY * self._share)
        self._late = False
