"""What people write of outages and restarts, and what of it is refused."""

from __future__ import annotations

import pytest

from tsgt.errors import ConfigError
from tsgt.simulation.options import Outage, Restart

STATIONS = (1, 2, 3)


@pytest.mark.parametrize(
    ("text", "outage"),
    [
        ("2:120:60", Outage((2,), 120.0, 60.0)),
        ("1,3:0.5:1.25", Outage((1, 3), 0.5, 1.25)),
        ("all:120:60", Outage(STATIONS, 120.0, 60.0)),
    ],
)
def test_outages(text: str, outage: Outage) -> None:
    """One station, some, or all; start and length in seconds."""
    assert Outage.parse(text, STATIONS) == outage


@pytest.mark.parametrize(
    ("text", "restart"), [("2:120", Restart(2, 120.0)), ("master:0.5", Restart(None, 0.5))]
)
def test_restarts(text: str, restart: Restart) -> None:
    """A station by its number, or the master."""
    assert Restart.parse(text, STATIONS) == restart


@pytest.mark.parametrize("text", ["", "2", "2:120", "2:120:", "2:-1:60", "two:120:60", "2;3:1:2", "2:nan:1"])
def test_what_is_no_outage(text: str) -> None:
    """It is refused with an example."""
    with pytest.raises(ConfigError, match="expected STATIONS:START:SECONDS, such as 2:120:60"):
        Outage.parse(text, STATIONS)


@pytest.mark.parametrize("text", ["", "2", "2:", "2:1:1", "all:3"])
def test_what_is_no_restart(text: str) -> None:
    """The same."""
    with pytest.raises(ConfigError, match="expected STATION:AT, such as 2:120"):
        Restart.parse(text, STATIONS)


def test_stations_that_there_are_not() -> None:
    """Nobody wonders afterwards why nothing happened."""
    with pytest.raises(ConfigError, match=r"outage '2,4:1:1': there is no station 4; there are 1, 2, 3"):
        Outage.parse("2,4:1:1", STATIONS)
    with pytest.raises(ConfigError, match=r"restart '0:1': there is no station 0"):
        Restart.parse("0:1", STATIONS)


def test_when_an_outage_lasts() -> None:
    """From its start, and no longer at its end."""
    outage = Outage((1,), 10.0, 5.0)
    assert [outage.covers(t) for t in (9.9, 10.0, 14.9, 15.0)] == [False, True, True, False]
