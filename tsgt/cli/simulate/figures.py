"""Figures of a simulated mission: delivery, rate, age and time errors of the measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.cli.simulate.poses import pose_keys
from tsgt.simulation.mission import JournalIndex

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from tsgt.simulation.mission import MissionResult, StationLog
    from tsgt.simulation.options import Outage


IN_TIME_NS = 2_000_000_000
"""Maximum age at which a measurement is still useful to a moving robot."""


@dataclass(frozen=True, slots=True)
class StationFigures:
    """Delivery and timing of one station's measurements.

    Attributes
    ----------
    measured
        Measurements read by the client before the end of the mission.
    delivered
        Distinct ones of them that reached the pipeline before the end of the drain.
    duplicates
        Measurements that reached the pipeline again.
    rate_hz
        Distinct measurements per second that reached the pipeline before the end of the mission: from the end of the
        initial synchronisation of all stations, with ``superframe`` from the first reception of the last station; NaN
        without.
    time_error_us
        Percentiles 50, 99 and 100 of the absolute timestamp error in us; NaN without measurements.
    age_ms
        Percentiles 50 and 99 of the time from measurement to pipeline in ms; NaN without measurements.
    within_2s
        Share of the measurements that reached the pipeline within :data:`IN_TIME_NS`.
    queued, missed_slots
        Measurements left in the station's send queue, and missed slots; None if the protocol has neither.
    """

    measured: int
    delivered: int
    duplicates: int
    rate_hz: float
    time_error_us: tuple[float, float, float]
    age_ms: tuple[float, float]
    within_2s: float
    queued: int | None
    missed_slots: int | None


@dataclass(frozen=True, slots=True)
class OutageFigures:
    """Effect of an outage.

    Attributes
    ----------
    drained_s
        Time from its end until all earlier measurements of its stations had arrived; NaN: never.
    live_age_ms
        Median age of the measurements made between the end of the outage and the end of the drain.
    time_error_us
        Percentiles 50, 99 and 100 of the absolute timestamp error of the measurements made during the outage.
    """

    drained_s: float
    live_age_ms: float
    time_error_us: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Delivery:
    """First delivery of a measurement; times in ns from the start."""

    measured_ns: int
    received_ns: int
    arrived_ns: int
    error_ns: int


@dataclass(frozen=True, slots=True)
class _Station:
    """Measurements of one station by true time in ns from the start, and their deliveries."""

    measured_ns: list[int]
    deliveries: dict[int, _Delivery]
    duplicates: int


def station_figures(run: MissionResult) -> dict[int, StationFigures]:
    """Return delivery and timing by station."""
    stations = _stations(run)
    return {number: _station_figures(run, number, stations) for number in run.station_logs}


def outage_figures(run: MissionResult) -> list[OutageFigures]:
    """Return the effect of each outage."""
    stations = _stations(run)
    return [_outage_figures(outage, stations) for outage in run.outages]


def _stations(run: MissionResult) -> dict[int, _Station]:
    return {number: _station(run, station_log) for number, station_log in run.station_logs.items()}


def _station(run: MissionResult, station_log: StationLog) -> _Station:
    """Match the deliveries of a station to its measurements before the end of the mission."""
    found = JournalIndex(station_log)
    end_ns = run.end_ns - run.start_ns
    deliveries: dict[int, _Delivery] = {}
    duplicates = 0
    for session in run.master_logs:
        seen: set[int] = set()
        for measurement, arrived_ns in zip(session.measurements, session.arrived_ns, strict=True):
            if measurement.station != station_log.station:
                continue
            true_ns = found.true_ns(measurement)
            if true_ns is None or true_ns > end_ns:
                continue
            duplicates += true_ns in seen
            seen.add(true_ns)
            delivery = _Delivery(
                measured_ns=true_ns,
                received_ns=measurement.received_ns - session.unix_at_zero_ns,
                arrived_ns=arrived_ns,
                error_ns=measurement.stamp_ns - session.unix_at_zero_ns - true_ns,
            )
            deliveries.setdefault(true_ns, delivery)
    measured_ns = [true_ns for true_ns in station_log.true_times_ns.values() if true_ns <= end_ns]
    return _Station(measured_ns, deliveries, duplicates)


def _counted_from_ns(run: MissionResult, stations: dict[int, _Station]) -> int | None:
    """Return when the last station was first synchronised, or received; None if one never was."""
    first_ns: dict[int, int] = {}
    for session in run.master_logs:
        for clock in session.clocks:
            first_ns.setdefault(clock.station, clock.stamp_ns - session.unix_at_zero_ns)
    for number, station in stations.items():
        if run.superframe and station.deliveries:
            first_ns[number] = min(delivery.received_ns for delivery in station.deliveries.values())
    return max(first_ns.values()) if first_ns.keys() >= run.station_logs.keys() else None


def _station_figures(run: MissionResult, number: int, stations: dict[int, _Station]) -> StationFigures:
    from_ns, end_ns = _counted_from_ns(run, stations), run.end_ns - run.start_ns
    station, statuses = stations[number], run.station_logs[number].statuses
    deliveries = station.deliveries.values()
    rate_hz = math.nan
    if from_ns is not None and from_ns < end_ns:
        counted = sum(from_ns <= delivery.received_ns <= end_ns for delivery in deliveries)
        rate_hz = counted / ((end_ns - from_ns) / 1e9)
    return StationFigures(
        measured=len(station.measured_ns),
        delivered=len(deliveries),
        duplicates=station.duplicates,
        rate_hz=rate_hz,
        time_error_us=_errors_us(deliveries),
        age_ms=_percentiles(_ages_ns(deliveries), 50, 99, unit_ns=1e6),
        within_2s=_within_2s(_ages_ns(deliveries), len(station.measured_ns)),
        queued=statuses[-1].queued if statuses else None,
        missed_slots=sum(status.missed_slots or 0 for status in statuses) if run.superframe else None,
    )


def _outage_figures(outage: Outage, stations: dict[int, _Station]) -> OutageFigures:
    start_ns, end_ns = round(outage.start_s * 1e9), round(outage.end_s * 1e9)
    those = [stations[number] for number in outage.stations]
    deliveries = [delivery for station in those for delivery in station.deliveries.values()]
    drained_ns = math.nan
    if all(ns in station.deliveries for station in those for ns in station.measured_ns if ns < end_ns):
        before = (delivery.arrived_ns for delivery in deliveries if delivery.measured_ns < end_ns)
        drained_ns = max(end_ns, *before) - end_ns
    live_ns = [
        delivery.arrived_ns - delivery.measured_ns
        for delivery in deliveries
        # Without a drain all later ones: comparisons with NaN are false.
        if end_ns <= delivery.measured_ns and not delivery.measured_ns > end_ns + drained_ns
    ]
    return OutageFigures(
        drained_s=drained_ns / 1e9,
        live_age_ms=_percentiles(live_ns, 50, unit_ns=1e6)[0],
        time_error_us=_errors_us([d for d in deliveries if start_ns <= d.measured_ns < end_ns]),
    )


def _ages_ns(deliveries: Collection[_Delivery]) -> list[int]:
    return [delivery.arrived_ns - delivery.measured_ns for delivery in deliveries]


def _within_2s(ages_ns: Sequence[int], measured: int) -> float:
    return sum(age_ns <= IN_TIME_NS for age_ns in ages_ns) / max(1, measured)


def _errors_us(deliveries: Collection[_Delivery]) -> tuple[float, float, float]:
    return _percentiles([abs(delivery.error_ns) for delivery in deliveries], 50, 99, 100, unit_ns=1e3)


def _percentiles(values_ns: Sequence[int], *percentiles: int, unit_ns: float) -> tuple[Any, ...]:
    if not values_ns:
        return (math.nan,) * len(percentiles)
    return tuple(float(value) for value in np.percentile(values_ns, percentiles) / unit_ns)


def frame_ms(run: MissionResult) -> float:
    """Return the mean interval between beacons in ms; NaN without beacons."""
    frames = sum(session.frame_count for session in run.master_logs)
    return (
        sum(session.frames_duration_ns for session in run.master_logs) / frames / 1e6 if frames else math.nan
    )


def figures(run: MissionResult) -> dict[str, Any]:
    """Return all figures for ``--json``."""
    return {
        "stations": {number: _station_keys(station) for number, station in station_figures(run).items()},
        "all": _all_keys(run),
        **({"frame_ms": frame_ms(run)} if run.superframe else {}),
        "outages": [
            {
                "stations": outage.stations,
                "start_s": outage.start_s,
                "seconds": outage.duration_s,
                "drained_s": found.drained_s,
                "live_age_ms": {"p50": found.live_age_ms},
                "time_error_us": dict(zip(("p50", "p99", "max"), found.time_error_us, strict=True)),
            }
            for outage, found in zip(run.outages, outage_figures(run), strict=True)
        ],
        **pose_keys(run),
        "airtime_fraction": run.airtime_s / run.duration_s,
        "sim_seconds": run.duration_s,
    }


def _all_keys(run: MissionResult) -> dict[str, Any]:
    """Return the figures of all stations together."""
    stations = _stations(run).values()
    measured = sum(len(station.measured_ns) for station in stations)
    deliveries = [delivery for station in stations for delivery in station.deliveries.values()]
    return {
        "measured": measured,
        "delivered": len(deliveries),
        "duplicates": sum(station.duplicates for station in stations),
        "time_error_us": dict(zip(("p50", "p99", "max"), _errors_us(deliveries), strict=True)),
        "age_ms": dict(
            zip(("p50", "p99"), _percentiles(_ages_ns(deliveries), 50, 99, unit_ns=1e6), strict=True)
        ),
        "within_2s": _within_2s(_ages_ns(deliveries), measured),
    }


def _station_keys(station: StationFigures) -> dict[str, Any]:
    return {
        "measured": station.measured,
        "delivered": station.delivered,
        "duplicates": station.duplicates,
        "rate_hz": station.rate_hz,
        "time_error_us": dict(zip(("p50", "p99", "max"), station.time_error_us, strict=True)),
        "age_ms": dict(zip(("p50", "p99"), station.age_ms, strict=True)),
        "within_2s": station.within_2s,
        "queued": station.queued,
        "missed_slots": station.missed_slots,
    }
