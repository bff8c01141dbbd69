"""A radio that hears packets, but none of them from its master."""

from __future__ import annotations

from structlog.testing import capture_logs

from tsgt.station.links.traffic_monitor import AGAIN_NS, PATIENCE_NS, Strangers


class SetClock:
    """Shows what it is set to."""

    def __init__(self) -> None:
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        """Return that."""
        return self.now_ns

    def realtime_ns(self) -> int:
        """Return that as well."""
        return self.now_ns

    async def sleep_until(self, monotonic_ns: int) -> None:
        """Go there."""
        self.now_ns = monotonic_ns


def test_packets_without_the_master_are_counted_and_told_seldom() -> None:
    """One warning after the patience, the next a minute later, however many packets come."""
    clock = SetClock()
    strangers = Strangers(clock)
    with capture_logs() as logs:
        for clock.now_ns in range(0, PATIENCE_NS + AGAIN_NS + 1, 1_000_000_000):
            strangers.heard(master=False)
    assert strangers.packets == 91
    assert [(line["event"], line["packets"], line["for_s"]) for line in logs] == [
        ("no_valid_beacon", 31, 30.0),
        ("no_valid_beacon", 91, 90.0),
    ]


def test_a_packet_of_the_master_ends_it() -> None:
    """Between its packets those of others are as it should be."""
    clock = SetClock()
    strangers = Strangers(clock)
    with capture_logs() as logs:
        for clock.now_ns in range(0, 3 * PATIENCE_NS, 1_000_000_000):
            strangers.heard(master=clock.now_ns % 4_000_000_000 == 0)
    assert strangers.packets == 1
    assert logs == []
