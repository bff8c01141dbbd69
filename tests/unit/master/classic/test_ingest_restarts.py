"""Ingest: clocks that may have been reset by a restart."""

from __future__ import annotations

import pytest
from harness.clocks.clock_exchanges import SECOND, START_NS, synchronisation

from tsgt.master.classic.ingest import StationIngest
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.classic.messages import no_measurement_yet
from tsgt.timesync.two_way import RegressionFilter, clock_filter

MS = 1_000_000
TURNAROUND_NS = 1_500_000


class Master:
    """Ingest of one station, at instants in s from the start."""

    def __init__(self, filter_name: str = "regression") -> None:
        self.ingest = StationIngest(1, 4, clock_filter(filter_name))  # type: ignore[arg-type]
        self.ahead_ns = 0

    def synchronise(self, at_s: float, *, cycles: int = 5) -> list[tuple[int, int | None]]:
        """Synchronise from an instant on; return stamp and bound of the released measurements, in ns."""
        samples = synchronisation(at_s, lambda _: self.ahead_ns, cycles=cycles, turnaround_ns=TURNAROUND_NS)
        found = self.ingest.synchronised(samples, samples[-1].received_ns)
        return [(m.stamp_ns, m.stamp_bound_ns) for m in found.measurements]

    def restart(self, at_s: float, step_ns: int) -> None:
        """Restart the station with a clock step, which it reports."""
        self.ahead_ns += step_ns
        now_ns = START_NS + round(at_s * SECOND)
        self.ingest.no_response()
        answer = no_measurement_yet(1)
        assert self.ingest.reply(
            answer, requested_ns=now_ns - 194 * MS, received_ns=now_ns
        ).needs_synchronisation

    def poll(
        self, at_s: float, *, made_s: float | None = None, status: int = 0
    ) -> tuple[int, int | None] | None:
        """Poll a measurement, made at an instant or 50 ms before the request; return its stamp and bound, in ns."""
        received_ns = START_NS + round(at_s * SECOND)
        made_ns = received_ns - 244 * MS if made_s is None else START_NS + round(made_s * SECOND)
        message = MeasurementMessage(
            station=1,
            status=status,
            zenith_angle_rad=1.5,
            horizontal_angle_rad=0.5,
            slope_distance_m=30.0 if status == 0 else 0.0,
            time_ns=made_ns + self.ahead_ns,
        )
        result = self.ingest.reply(message, requested_ns=received_ns - 194 * MS, received_ns=received_ns)
        measurement = result.measurement
        return None if measurement is None else (measurement.stamp_ns, measurement.stamp_bound_ns)


@pytest.mark.parametrize(
    ("first_ms", "second_ms", "apart_s"), [(1.5, 3.0, 60), (-1.5, -3.0, 60), (1.5, 1.0, 20)]
)
def test_two_small_steps_are_not_taken_for_a_skew(first_ms: float, second_ms: float, apart_s: float) -> None:
    """Each step is too small for an exchange; stamps stay within their bounds."""
    master = Master()
    master.synchronise(0, cycles=50)
    master.restart(24, round(first_ms * MS))
    master.synchronise(25)
    master.restart(24 + apart_s, round(second_ms * MS))
    master.synchronise(25 + apart_s)
    for number in range(170):
        at_s = 27 + apart_s + number / 2
        found = master.poll(at_s)
        assert found is not None
        stamp_ns, bound_ns = found
        assert bound_ns is not None
        assert abs(stamp_ns - (START_NS + round(at_s * SECOND) - 244 * MS)) <= bound_ns


def test_regression_does_not_span_a_restart() -> None:
    """The known skew remains a prior."""
    through, restarted = RegressionFilter(), RegressionFilter()
    for clock in (through, restarted):
        clock.update(synchronisation(0, lambda _: 0.0, cycles=50, turnaround_ns=TURNAROUND_NS))
    stepped = synchronisation(30, lambda _: 1.0 * MS, turnaround_ns=TURNAROUND_NS)
    through.update(stepped)
    assert not restarted.update(stepped, may_have_restarted=True).restarted  # as far as exchanges tell
    at_ns = stepped[-1].station_ns
    assert abs(through.at(at_ns).skew_ppm) > 20
    assert abs(restarted.at(at_ns).skew_ppm) < 2


@pytest.mark.parametrize("apart_s", [28, 60])
def test_unnoticed_restart_before_the_first_measurement_is_handled(apart_s: int) -> None:
    """The station was not polled meanwhile; the regression does not span the step."""
    master = Master()
    master.synchronise(0)
    master.ahead_ns += 1_800_000
    now_ns = START_NS + apart_s * SECOND
    answer = no_measurement_yet(1)
    assert master.ingest.reply(
        answer, requested_ns=now_ns - 194 * MS, received_ns=now_ns
    ).needs_synchronisation
    master.synchronise(apart_s + 0.5)
    for number in range(170):
        at_s = apart_s + 3 + number / 2
        found = master.poll(at_s)
        assert found is not None
        stamp_ns, bound_ns = found
        assert bound_ns is not None
        assert abs(stamp_ns - (START_NS + round(at_s * SECOND) - 244 * MS)) <= bound_ns


def test_papers_filter_ignores_restarts() -> None:
    """As in the paper."""
    plain, restarted = clock_filter("paper"), clock_filter("paper")
    for clock in (plain, restarted):
        clock.update(synchronisation(0, lambda _: 0.0))
    stepped = synchronisation(30, lambda _: 1.0 * MS)
    plain.update(stepped)
    restarted.update(stepped, may_have_restarted=True)
    assert plain.at(stepped[-1].station_ns) == restarted.at(stepped[-1].station_ns)


def test_measurement_with_a_suspended_clock_is_held() -> None:
    """It is stamped with the clock of the next synchronisation."""
    master = Master()
    master.synchronise(0)
    assert master.poll(2.0) is not None
    master.ingest.suspend()
    master.ahead_ns += 30 * MS
    assert master.poll(3.0) is None
    ((stamp_ns, _),) = master.synchronise(3.5)
    assert stamp_ns == pytest.approx(START_NS + 2756 * MS, abs=2 * MS)
    assert master.poll(6.0) is not None


def test_late_error_is_reported_once() -> None:
    """With its arrival as time, as it appeared old; its repetition is recognised."""
    master = Master()
    master.synchronise(0)
    assert master.poll(2.0) is not None
    master.ingest.no_response()
    assert master.poll(5.0, made_s=2.5, status=3) is not None
    master.ingest.no_response()
    assert master.poll(11.0, made_s=2.5, status=3) is None
    assert master.synchronise(12.0) == []


def test_authors_node_errors_are_recognised_by_their_status() -> None:
    """Their time is constant and meaningless."""
    master = Master()
    master.synchronise(0)
    reported = []
    for number, status in enumerate((1, 2, 2, 1)):
        received_ns = START_NS + (2 + number) * SECOND
        message = MeasurementMessage(
            station=1,
            status=status,
            zenith_angle_rad=-1.0,
            horizontal_angle_rad=-1.0,
            slope_distance_m=-1.0,
            time_ns=12_345 * SECOND,
        )
        result = master.ingest.reply(message, requested_ns=received_ns - 194 * MS, received_ns=received_ns)
        reported.append(None if result.measurement is None else result.measurement.raw_status)
    assert reported == [1, 2, None, 1]
