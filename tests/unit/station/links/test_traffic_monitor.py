"""Packets of unknown origin while the master is silent."""

from __future__ import annotations

from structlog.testing import capture_logs

from tsgt.station.links.traffic_monitor import SILENCE_TIMEOUT_NS, WARNING_INTERVAL_NS, UnknownTrafficMonitor


class SettableClock:
    """A clock that shows what the test sets."""

    def __init__(self) -> None:
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        """Return the time set."""
        return self.now_ns

    def realtime_ns(self) -> int:
        """Return the time set."""
        return self.now_ns

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Set the time."""
        self.now_ns = monotonic_ns


def test_unknown_packets_are_counted_and_reported_once_a_minute() -> None:
    """The first warning comes after the silence timeout, the next a minute later, however many packets arrive."""
    clock = SettableClock()
    monitor = UnknownTrafficMonitor(clock)
    with capture_logs() as logs:
        for clock.now_ns in range(0, SILENCE_TIMEOUT_NS + WARNING_INTERVAL_NS + 1, 1_000_000_000):
            monitor.received(from_master=False)
    assert monitor.packets == 91
    assert [(line["event"], line["packets"], line["for_s"]) for line in logs] == [
        ("no_valid_beacon", 31, 30.0),
        ("no_valid_beacon", 91, 90.0),
    ]


def test_packet_from_master_resets_count() -> None:
    """Unknown packets between those of the master cause no warning."""
    clock = SettableClock()
    monitor = UnknownTrafficMonitor(clock)
    with capture_logs() as logs:
        for clock.now_ns in range(0, 3 * SILENCE_TIMEOUT_NS, 1_000_000_000):
            monitor.received(from_master=clock.now_ns % 4_000_000_000 == 0)
    assert monitor.packets == 1
    assert logs == []
