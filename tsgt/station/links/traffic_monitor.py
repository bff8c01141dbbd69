"""Notices that a radio hears packets, but none of them from its master."""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from tsgt.clock import Clock

PATIENCE_NS = 30_000_000_000
"""A station that has just started may need some frames to understand its master, with 16 stations for 24 s."""

AGAIN_NS = 60_000_000_000
"""From one warning to the next."""

log = structlog.get_logger()


class Strangers:
    """Counts the packets since the master's last one, and warns when it has not been heard among them for long.

    Parameters
    ----------
    clock
        Of this computer.

    Attributes
    ----------
    packets
        How many have come since the master's last one.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since_ns = clock.monotonic_ns()
        self._warn_ns = self._since_ns + PATIENCE_NS
        self.packets = 0

    def heard(self, *, master: bool) -> None:
        """Take note of a packet: the master's, or any other."""
        now_ns = self._clock.monotonic_ns()
        if master:
            self._since_ns, self._warn_ns, self.packets = now_ns, now_ns + PATIENCE_NS, 0
            return
        self.packets += 1
        if now_ns >= self._warn_ns:
            self._warn_ns = now_ns + AGAIN_NS
            log.warning("no_valid_beacon", packets=self.packets, for_s=(now_ns - self._since_ns) / 1e9)
