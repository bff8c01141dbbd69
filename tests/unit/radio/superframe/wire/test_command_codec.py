from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.radio import DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand
from tsgt.radio.superframe.wire import decode_command, encode_command
from tsgt.radio.superframe.wire.codec import spread_rad


@pytest.mark.parametrize(
    "order",
    [
        TrackCommand(16),
        SearchCommand(),
        SearchCommand(Direction(math.pi, 1.5 * math.pi, spread_rad(5))),
        DirectCommand(),
        MeasureCommand(),
    ],
)
def test_commands_round_trip(order: TrackCommand | SearchCommand | DirectCommand | MeasureCommand) -> None:
    """A direction within its rounding, which increases the spread by one step."""
    part = encode_command(3, 9, order, tracked=2)
    assert (part.station, part.command_id) == (3, 9)
    back = decode_command(part)
    if isinstance(order, SearchCommand) and order.towards is not None:
        order = SearchCommand(Direction(math.pi, 1.5 * math.pi, spread_rad(6)))
    assert back == order


def test_track_without_prism_means_tracked_prism() -> None:
    """The station may know another one."""
    assert decode_command(encode_command(1, 0, TrackCommand(None), tracked=7)) == TrackCommand(7)


@given(
    horizontal_rad=st.floats(-1.0, 10.0),
    zenith_rad=st.floats(0.0, math.tau),
    wide_rad=st.floats(0.0, math.radians(45.2)),
)
def test_encoded_direction_covers_search_area(
    horizontal_rad: float, zenith_rad: float, wide_rad: float
) -> None:
    """And not much more."""
    order = decode_command(
        encode_command(1, 0, SearchCommand(Direction(horizontal_rad, zenith_rad, wide_rad)), tracked=1)
    )
    assert isinstance(order, SearchCommand)
    back = order.towards
    assert back is not None
    aside = [
        abs(math.remainder(after_rad - before_rad, math.tau))
        for after_rad, before_rad in (
            (back.horizontal_angle_rad, horizontal_rad),
            (back.zenith_angle_rad, zenith_rad),
        )
    ]
    assert math.hypot(*aside) + wide_rad <= back.spread_rad + 1e-12
    assert back.spread_rad <= max(math.sqrt(2) * (wide_rad + 1e-4), spread_rad(0))


def test_spread_is_limited() -> None:
    """To 45 degrees on every side."""
    order = decode_command(encode_command(1, 0, SearchCommand(Direction(0.0, 1.5, 3.0)), tracked=1))
    assert isinstance(order, SearchCommand)
    assert order.towards is not None
    assert math.degrees(order.towards.spread_rad) == pytest.approx(45.25, abs=0.01)
