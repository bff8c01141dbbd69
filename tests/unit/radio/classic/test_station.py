from __future__ import annotations

import pytest

from tsgt.radio import DirectCommand, MeasureCommand, TrackCommand
from tsgt.radio.classic import ClassicStation, MeasurementMessage
from tsgt.radio.classic.messages import no_measurement_yet

NONE_YET = no_measurement_yet(1).to_bytes()
SOME = MeasurementMessage(
    station=1,
    status=0,
    zenith_angle_rad=1.5,
    horizontal_angle_rad=2.0,
    slope_distance_m=50.0,
    time_ns=1_000_000_007,
)


@pytest.fixture
def station() -> ClassicStation:
    """Return station 1, as it starts."""
    return ClassicStation(1)


def test_poll_before_the_first_measurement_has_a_reply(station: ClassicStation) -> None:
    """Silence would cost the master its timeout; the reply is no good measurement."""
    assert station.received(b"t1", 5) == NONE_YET
    assert NONE_YET[:2] == b"\x01\x03"


def test_newest_measurement_is_repeated(station: ClassicStation) -> None:
    """A measurement answers every poll until there is a newer one."""
    station.received(b"e1", 4)
    station.measured(SOME)
    assert [station.received(b"t1", 5) for _ in range(2)] == [SOME.to_bytes()] * 2


def test_restarted_station_has_no_measurement_until_it_is_synchronised(station: ClassicStation) -> None:
    """A master that knew it before its restart must learn that its clock may be another one."""
    station.measured(SOME)
    assert [station.received(b"t1", 5) for _ in range(2)] == [NONE_YET] * 2
    station.received(b"e1", 6)
    assert station.received(b"t1", 7) == SOME.to_bytes()


def test_unsynchronised_station_sends_measurements_after_eight_polls(
    station: ClassicStation,
) -> None:
    """The authors' master synchronises on its own schedule."""
    station.measured(SOME)
    assert [station.received(b"t1", 5) for _ in range(9)] == [NONE_YET] * 8 + [SOME.to_bytes()]


@pytest.mark.parametrize("payload", [b"", b"t2", b"e2", b"x1", b"e1 ", bytes(34), SOME.to_bytes(), b"dOk"])
def test_other_packets_are_ignored(station: ClassicStation, payload: bytes) -> None:
    """Commands for other stations, replies, and unknown packets have no reply."""
    assert station.received(payload, 5) is None


def test_ping_is_timestamped(station: ClassicStation) -> None:
    """The timestamp is the reception of the last ping, however often it is requested."""
    assert [station.received(payload, at) for payload, at in ((b"p1", 1), (b"e1", 2), (b"e2", 3))] == [
        None,
        b"e1",
        None,
    ]
    assert [station.received(payload, 4) for payload in (b"s1", b"s1", b"c1", b"s1")] == [
        bytes.fromhex("73 00000000 02000000"),
        bytes.fromhex("73 00000000 02000000"),
        None,
        bytes.fromhex("73 00000000 02000000"),
    ]


def test_timestamp_without_a_ping_is_zero(station: ClassicStation) -> None:
    """A timestamp of zero means none."""
    assert station.received(b"s1", 5) == b"s" + bytes(8)


def test_command_is_executed_once(station: ClassicStation) -> None:
    """Each command to direct mode and back is executed once, and acknowledged again when repeated."""
    assert station.received(b"d1", 5) == DirectCommand()
    assert station.executed(DirectCommand(), ok=True) == b"dOk"
    assert station.received(b"d1", 6) == b"dOk"
    assert station.received(b"n1", 7) == TrackCommand(None)
    assert station.executed(TrackCommand(None), ok=True) == b"nOk"
    assert station.received(b"n1", 8) == b"nOk"


def test_failed_command_changes_nothing(station: ClassicStation) -> None:
    """After ``dNo`` the station continues to track, after ``nNo`` it stays in direct mode."""
    station.received(b"e1", 4)
    station.measured(SOME)
    station.received(b"d1", 5)
    assert station.executed(DirectCommand(), ok=False) == b"dNo"
    assert station.received(b"t1", 6) == SOME.to_bytes()
    station.received(b"d1", 7)
    station.executed(DirectCommand(), ok=True)
    station.received(b"n1", 8)
    assert station.executed(TrackCommand(None), ok=False) == b"nNo"
    assert station.received(b"t1", 9) == MeasureCommand()


def test_another_prism_is_a_new_command(station: ClassicStation) -> None:
    """The first command for a prism is executed, its repetition acknowledged, the next prism is a new command."""
    assert station.received(b"n13", 5) == TrackCommand(3)
    assert station.executed(TrackCommand(3), ok=True) == b"nOk"
    assert station.received(b"n13", 6) == b"nOk"
    assert station.received(b"n14", 7) == TrackCommand(4)


def test_measurement_of_the_previous_prism_is_not_sent(station: ClassicStation) -> None:
    """The message does not name its prism, so the old measurement must not pass for one of the new prism."""
    station.measured(SOME)
    station.received(b"n14", 5)
    station.executed(TrackCommand(4), ok=True)
    assert station.received(b"t1", 6) == NONE_YET


def test_polls_in_direct_mode_are_single_measurements(station: ClassicStation) -> None:
    """Each poll commands one measurement, which is its reply."""
    station.measured(SOME)
    station.received(b"d1", 5)
    station.executed(DirectCommand(), ok=True)
    for _ in range(2):
        assert station.received(b"t1", 6) == MeasureCommand()
        assert station.single_measured(SOME) == SOME.to_bytes()


def test_one_command_at_a_time(station: ClassicStation) -> None:
    """During a command others are ignored; polls and pings have replies."""
    station.received(b"e1", 4)
    station.measured(SOME)
    station.received(b"d1", 5)
    assert [station.received(payload, 6) for payload in (b"d1", b"n1", b"n13")] == [None] * 3
    assert [station.received(payload, 7) for payload in (b"t1", b"e1")] == [SOME.to_bytes(), b"e1"]
    station.executed(DirectCommand(), ok=True)
    station.received(b"t1", 8)
    assert [station.received(payload, 9) for payload in (b"t1", b"d1", b"n1")] == [None] * 3
    station.single_measured(SOME)
    assert station.received(b"d1", 10) == b"dOk"
