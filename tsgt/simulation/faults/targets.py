"""What a fault hits: a station, or the computer of a station or of the master."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.simulation.mission import MASTER, station_name

if TYPE_CHECKING:
    from tsgt.simulation.faults.catalogue import Fault


def target_station(fault: Fault) -> int:
    """Return the number of the station that a fault hits."""
    if fault.station is None:
        raise ValueError(f"a fault {fault.kind} needs a station")
    return fault.station


def target_computer(fault: Fault) -> str:
    """Return the name of the computer that a fault hits."""
    return MASTER if fault.station is None else station_name(fault.station)
