"""Detects that a station receives packets, but none from its master."""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from tsgt.clock import Clock

SILENCE_TIMEOUT_NS = 30_000_000_000
"""A station that has just started may need some frames to decode its master's beacons: 24 s with 16 stations."""

WARNING_INTERVAL_NS = 60_000_000_000

log = structlog.get_logger()


class UnknownTrafficMonitor:
    """Counts packets of unknown origin since the master's last one; warns when the master stays silent."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since_ns = clock.monotonic_ns()
        self._warn_ns = self._since_ns + SILENCE_TIMEOUT_NS
        self.packets = 0

    def received(self, *, from_master: bool) -> None:
        """Count a packet."""
        now_ns = self._clock.monotonic_ns()
        if from_master:
            self._since_ns, self._warn_ns, self.packets = now_ns, now_ns + SILENCE_TIMEOUT_NS, 0
            return
        self.packets += 1
        if now_ns >= self._warn_ns:
            self._warn_ns = now_ns + WARNING_INTERVAL_NS
            log.warning("no_valid_beacon", packets=self.packets, for_s=(now_ns - self._since_ns) / 1e9)
