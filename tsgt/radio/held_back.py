"""What the master makes of replies that come late: somebody holds back the beacons that they answer."""

from __future__ import annotations

UNNOTICED_NS = 30_000_000
"""A beacon that was held back for longer may agree with others, as far as the low bits of their times tell."""


class HeldBack:
    """Whether beacons are held back from a station for longer than it can notice by the low bits of their times.

    Its replies come late by as much. As long as beacons say their times in full, the first one that comes when it should
    contradicts those that did not: with the next one the station knows.

    Attributes
    ----------
    by_ns
        By how much, at most, since it began; 0 from the second reply in a row on that is on time, if the station has been
        told when the beacon of the first one left.
    """

    def __init__(self) -> None:
        self.by_ns = 0
        self._on_time: int | None = None

    def add(self, counter: int, late_ns: int, *, told: bool) -> None:
        """Take by how much the reply to a frame was late.

        Parameters
        ----------
        counter
            Number of the frame.
        late_ns
            By how much, at most.
        told
            The next beacon says when this one left; else the station cannot compare it with others.
        """
        if late_ns > UNNOTICED_NS:
            self.by_ns, self._on_time = max(self.by_ns, late_ns), None
            return
        if self._on_time == counter - 1:
            self.by_ns = 0
        self._on_time = counter if told else None
