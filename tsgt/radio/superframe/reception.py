"""What a reply of the superframe brings to the master, in SI units and on the master's clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.model import Status
    from tsgt.radio.commands import Order
    from tsgt.radio.superframe.wire import AnswerPart, ShotPart, StatePart


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedSighting:
    """A measurement with its time.

    Attributes
    ----------
    sequence
        Running number, in full.
    prism
        Number of the prism.
    measured_ns
        When it was made, on the master's CLOCK_MONOTONIC; may lie before the master's start, even below zero.
    sigma_ns
        One sigma of that.
    bound_ns
        ``measured_ns`` is within this of the truth.
    status, horizontal_angle_rad, zenith_angle_rad, slope_distance_m
        As the instrument gave them, within half a unit of the air: 0.19 microradians, 0.05 mm (0.5 mm beyond 1.6 km).
    """

    sequence: int
    prism: int
    measured_ns: int
    sigma_ns: int
    bound_ns: int
    status: Status
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """What a reply brought.

    Attributes
    ----------
    station
        Number of the sender.
    sightings
        Those that are new, in the order in which they were made.
    repeated
        How many it held that had come before.
    joined
        The station has just introduced itself: it, or this master, is new.
    state
        How it does, where the reply says so.
    order, answer, shot
        What became of an order, and which it was: given once, however often the station says it.
    doubted_beacons
        How many beacons it has received since its last word at a time at which they cannot have been sent.
    link_delay_anomaly
        A self-calibration came to something that cannot be: somebody may be delaying packets.
    lateness_ns
        By how much it came later than its slot foresees.
    """

    station: int
    sightings: tuple[TimedSighting, ...] = ()
    repeated: int = 0
    joined: bool = False
    state: StatePart | None = None
    order: Order | None = None
    answer: AnswerPart | None = None
    shot: ShotPart | None = None
    doubted_beacons: int = 0
    link_delay_anomaly: bool = False
    lateness_ns: int = 0
