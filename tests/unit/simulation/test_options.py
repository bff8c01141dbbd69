"""Parsing of outages and restarts."""

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
def test_outages_are_parsed(text: str, outage: Outage) -> None:
    """One station, several, or all; start and duration in seconds."""
    assert Outage.parse(text, STATIONS) == outage


@pytest.mark.parametrize(
    ("text", "restart"), [("2:120", Restart(2, 120.0)), ("master:0.5", Restart(None, 0.5))]
)
def test_restarts_are_parsed(text: str, restart: Restart) -> None:
    """A station by its number, or the master."""
    assert Restart.parse(text, STATIONS) == restart


@pytest.mark.parametrize("text", ["", "2", "2:120", "2:120:", "2:-1:60", "two:120:60", "2;3:1:2", "2:nan:1"])
def test_malformed_outage_is_rejected(text: str) -> None:
    """The error shows an example."""
    with pytest.raises(ConfigError, match="expected STATIONS:START:SECONDS, such as 2:120:60"):
        Outage.parse(text, STATIONS)


@pytest.mark.parametrize("text", ["", "2", "2:", "2:1:1", "all:3"])
def test_malformed_restart_is_rejected(text: str) -> None:
    """The error shows an example."""
    with pytest.raises(ConfigError, match="expected STATION:AT, such as 2:120"):
        Restart.parse(text, STATIONS)


def test_unknown_station_is_rejected() -> None:
    """The error names the stations of the scenario."""
    with pytest.raises(ConfigError, match=r"outage '2,4:1:1': there is no station 4; there are 1, 2, 3"):
        Outage.parse("2,4:1:1", STATIONS)
    with pytest.raises(ConfigError, match=r"restart '0:1': there is no station 0"):
        Restart.parse("0:1", STATIONS)


def test_outage_includes_its_start_and_excludes_its_end() -> None:
    """The interval is half open."""
    outage = Outage((1,), 10.0, 5.0)
    assert [outage.covers(t) for t in (9.9, 10.0, 14.9, 15.0)] == [False, True, True, False]
