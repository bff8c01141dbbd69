"""Ingest: replies to measurements on the master's clock."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import hypothesis.strategies as st
import pytest
from harness.drives.scene import START
from hypothesis import given
from hypothesis import settings as limits

from tsgt.master.classic import UNTIMED_SIGMA_NS
from tsgt.master.classic.ingest import ClockEvent, ClockState, StationIngest, next_clock_state
from tsgt.model import ClockSample, Status
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.classic.messages import decode_reply, no_measurement_yet
from tsgt.timesync.two_way import clock_filter

if TYPE_CHECKING:
    from tsgt.master.classic.ingest import PollResult, SynchronisationResult

MS = 1_000_000
SECOND = 1000 * MS
AIR_NS = 55 * MS
AHEAD_NS = 7200 * SECOND


def samples(at_ns: int, ahead_ns: int = AHEAD_NS, count: int = 5, *, late_ns: int = 0) -> list[ClockSample]:
    """Return exchanges 0.25 s apart, the last of which ends at an instant, with a delayed station."""
    return [
        ClockSample(
            sent_ns=received_ns - late_ns - 2 * AIR_NS,
            station_ns=received_ns - late_ns - AIR_NS + ahead_ns,
            received_ns=received_ns,
            forward_ns=AIR_NS,
            back_ns=AIR_NS,
        )
        for received_ns in range(at_ns - (count - 1) * 250 * MS, at_ns + 1, 250 * MS)
    ]


def message(time_ns: int, *, status: int = 0, distance_m: float = 30.0) -> MeasurementMessage:
    """Return a message of station 1."""
    return MeasurementMessage(
        station=1,
        status=status,
        zenith_angle_rad=1.5,
        horizontal_angle_rad=0.5,
        slope_distance_m=distance_m,
        time_ns=time_ns,
    )


def failure(status: int) -> MeasurementMessage:
    """Return the message of an authors' node that reports an error."""
    return replace(
        message(0, status=status), zenith_angle_rad=-1.0, horizontal_angle_rad=-1.0, slope_distance_m=-1.0
    )


class Master:
    """Ingest of one station, polled at instants in ms from the start."""

    def __init__(self, *, synchronised: bool = True) -> None:
        self.ingest = StationIngest(1, 4, clock_filter("regression"))
        if synchronised:
            self.synchronise(0)

    def synchronise(self, at_ms: int, ahead_ns: int = AHEAD_NS, *, late_ns: int = 0) -> SynchronisationResult:
        """Pass a synchronisation whose last exchange ends at an instant."""
        at_ns = START + at_ms * MS
        return self.ingest.synchronised(samples(at_ns, ahead_ns, late_ns=late_ns), at_ns)

    def poll(self, at_ms: int, answer: MeasurementMessage) -> PollResult:
        """Pass a reply that is received at an instant, 194 ms after the start of its request."""
        received_ns = START + at_ms * MS
        return self.ingest.reply(answer, requested_ns=received_ns - 194 * MS, received_ns=received_ns)


def test_measurement_is_converted_to_the_masters_clock() -> None:
    """The stamp is the host's minus the station's offset; raw values are unchanged."""
    result = Master().poll(1000, message(START + 750 * MS + AHEAD_NS))
    assert not result.stepped
    measurement = result.measurement
    assert measurement is not None
    assert measurement.stamp_ns == pytest.approx(START + 750 * MS, abs=20_000)
    assert measurement.host_time_ns == START + 750 * MS + AHEAD_NS
    assert (measurement.station, measurement.prism, measurement.sequence) == (1, 4, 0)
    assert measurement.received_ns == START + 1000 * MS
    assert 0 < measurement.stamp_sigma_ns < MS


def test_repeated_measurement_is_ignored() -> None:
    """Repeated measurement is ignored."""
    master = Master()
    assert master.poll(1000, message(START + 750 * MS + AHEAD_NS)).measurement is not None
    assert master.poll(1500, message(START + 750 * MS + AHEAD_NS)).measurement is None
    measurement = master.poll(2000, message(START + 1750 * MS + AHEAD_NS)).measurement
    assert measurement is not None
    assert measurement.sequence == 1


@pytest.mark.parametrize(
    "answer",
    [no_measurement_yet(1), replace(message(0), zenith_angle_rad=0.0, slope_distance_m=0.0)],
    ids=["ours", "authors'"],
)
def test_no_measurement_yet_is_ignored(answer: MeasurementMessage) -> None:
    """Time 0 means none, whatever the status."""
    result = Master().poll(1000, answer)
    assert result == (None, False, False)


def test_error_without_a_time_is_reported_once_per_change() -> None:
    """Its stamp is the arrival, with a large sigma; it is no sign of a clock step."""
    master = Master()
    results = [master.poll(1000 * n, failure(status)) for n, status in enumerate((1, 1, 2, 2, 2, 1), start=1)]
    reported = [result.measurement for result in results if result.measurement is not None]
    assert [m.status for m in reported] == [Status.TILT, Status.WRONG_DISTANCE, Status.TILT]
    assert [m.stamp_ns - START for m in reported] == [1000 * MS, 3000 * MS, 6000 * MS]
    assert {m.stamp_sigma_ns for m in reported} == {UNTIMED_SIGMA_NS}
    assert {m.slope_distance_m for m in reported} == {None}
    assert not any(result.stepped for result in results)


def test_error_with_an_impossible_time_has_none() -> None:
    """The time field of an authors' node that reports an error is meaningless."""
    master = Master()
    master.poll(500, message(START + 250 * MS + AHEAD_NS))
    result = master.poll(1000, replace(failure(3), time_ns=12_345 * SECOND))
    assert result.measurement is not None
    assert result.measurement.stamp_ns == START + 1000 * MS
    assert not result.stepped


def test_error_with_a_valid_time_is_stamped_with_it() -> None:
    """Clients stamp errors like measurements."""
    result = Master().poll(1000, message(START + 800 * MS + AHEAD_NS, status=1))
    assert result.measurement is not None
    assert result.measurement.status is Status.TILT
    assert result.measurement.stamp_ns == pytest.approx(START + 800 * MS, abs=20_000)


@pytest.mark.parametrize("step_s", [3600, 0.4, -3.0, -1e6, -1.6e9])
def test_measurements_after_a_step_are_held(step_s: float) -> None:
    """The first one reports the step; all are released with the new clock."""
    master = Master()
    step_ns = round(step_s * 1e9)
    master.poll(1000, message(START + 750 * MS + AHEAD_NS))
    made_ms = (2000, 2400, 2800)
    results = [master.poll(ms + 200, message(START + ms * MS + AHEAD_NS + step_ns)) for ms in made_ms]
    assert [(a.measurement, a.stepped, a.needs_synchronisation) for a in results] == [
        (None, True, True),
        (None, False, False),
        (None, False, False),
    ]
    assert master.ingest.clock(START + 3000 * MS) is None
    found = master.synchronise(4500, AHEAD_NS + step_ns)
    assert found.record.restarted
    assert not found.stepped  # already reported
    assert [round((m.stamp_ns - START) / MS) for m in found.measurements] == list(made_ms)
    assert [m.sequence for m in found.measurements] == [1, 2, 3]
    assert master.poll(5000, message(START + 4900 * MS + AHEAD_NS + step_ns)).measurement is not None


def test_small_step_is_detected_by_a_synchronisation() -> None:
    """20 ms could also be a delay."""
    master = Master()
    assert master.poll(1000, message(START + 750 * MS + AHEAD_NS + 5 * MS)).measurement is not None
    found = master.synchronise(30_000, AHEAD_NS + 20 * MS)
    assert found.stepped
    assert found.record.restarted


def test_clock_record_has_estimate_and_samples() -> None:
    """Clock record has estimate and samples."""
    found = Master(synchronised=False).synchronise(0)
    assert found.measurements == []
    assert found.record.offset_ns == pytest.approx(AHEAD_NS, abs=20_000)
    assert found.record.samples == tuple(samples(START))
    assert (found.record.filter, found.record.restarted, found.record.rejected) == ("regression", True, 0)


def test_measurements_before_the_first_synchronisation_are_held() -> None:
    """Measurements before the first synchronisation are held."""
    master = Master(synchronised=False)
    assert master.poll(1000, message(START + 750 * MS + AHEAD_NS)) == (None, False, False)
    (measurement,) = master.synchronise(2300).measurements
    assert measurement.stamp_ns == pytest.approx(START + 750 * MS, abs=20_000)


def test_distance_zero_is_none() -> None:
    """Distance zero is none."""
    result = Master().poll(1000, message(START + 750 * MS + AHEAD_NS, status=4, distance_m=0.0))
    assert result.measurement is not None
    assert result.measurement.status is Status.ANGLE_ONLY
    assert result.measurement.slope_distance_m is None


@limits(max_examples=200)
@given(
    st.lists(
        st.one_of(
            st.builds(
                lambda head, tail: bytes([1, head % 5]) + tail,
                st.integers(0, 4),
                st.binary(min_size=32, max_size=32),
            ),
            st.builds(message, st.integers(0, 2**32 * SECOND - 1), status=st.integers(0, 4)).map(
                MeasurementMessage.to_bytes
            ),
            st.just(None),
        ),
        max_size=12,
    )
)
@pytest.mark.slow
def test_any_message_gives_valid_instants(answers: list[bytes | None]) -> None:
    """Any 34 bytes, with synchronisations at any time."""
    master = Master()
    for number, answer in enumerate(answers, start=1):
        if answer is None:
            for measurement in master.synchronise(number * 1000).measurements:
                assert measurement.stamp_ns >= 0
            continue
        decoded = decode_reply(answer)
        if isinstance(decoded, MeasurementMessage):
            master.poll(number * 1000, decoded)


def test_silent_station_needs_a_synchronisation() -> None:
    """A clock that was stopped during the outage makes new measurements look old."""
    master = Master()
    assert master.poll(1000, message(START + 700 * MS + AHEAD_NS)).measurement is not None
    master.ingest.no_response()
    off_ns = 20 * SECOND  # its clock went on from where it was when the power went
    back = master.poll(21_200, message(START + 21_000 * MS - off_ns + AHEAD_NS))
    assert back.measurement is None
    assert back.needs_synchronisation
    assert not back.stepped
    found = master.synchronise(22_500, AHEAD_NS - off_ns)
    assert found.stepped
    (measurement,) = found.measurements
    assert measurement.stamp_ns == pytest.approx(START + 21_000 * MS, abs=MS)


def test_station_that_was_not_polled_needs_no_synchronisation() -> None:
    """While others are synchronised it is not polled."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    later = master.poll(30_000, message(START + 29_800 * MS + AHEAD_NS))
    assert later.measurement is not None
    assert not later.needs_synchronisation


def test_consistent_synchronisation_after_a_silence_is_no_step() -> None:
    """Held measurements are released without an event."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response()
    assert master.poll(21_200, message(START + 21_000 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(23_000)
    assert not found.stepped
    assert [m.stamp_ns for m in found.measurements] == [pytest.approx(START + 21_000 * MS, abs=MS)]


def test_backward_step_between_repeats_is_detected() -> None:
    """Repeats show that there was no measurement before them."""
    master = Master()
    same = message(START + 700 * MS + AHEAD_NS)
    for at_ms in (1000, 1600, 2200, 2800):
        master.poll(at_ms, same)
    assert master.poll(3400, message(START + 3200 * MS + AHEAD_NS - 1500 * MS)).stepped


def test_stale_measurement_is_held() -> None:
    """The clock was stopped while others were synchronised, and no request was lost."""
    master = Master()
    off_ns = 15 * SECOND
    back = master.poll(15_200, message(START + 15_000 * MS - off_ns + AHEAD_NS))
    assert back == (None, False, True)
    (measurement,) = master.synchronise(16_500, AHEAD_NS - off_ns).measurements
    assert measurement.stamp_ns == pytest.approx(START + 15_000 * MS, abs=MS)


@pytest.mark.parametrize("step_s", [6.0, -6.0, 1e8, -1e8, 3e9])
def test_held_measurement_of_an_earlier_clock_is_dropped(step_s: float) -> None:
    """Its time is unknown; the station's journal has it."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response()
    assert master.poll(8000, message(START + 7800 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(20_000, AHEAD_NS + round(step_s * 1e9) if step_s < 1e9 else AHEAD_NS - START)
    assert found.stepped
    assert found.measurements == []


@pytest.mark.parametrize("known", [True, False])
def test_held_measurement_of_an_ambiguous_clock_is_dropped(known: bool) -> None:  # noqa: FBT001
    """Half a second apart, both clocks explain it, unless no request was lost."""
    master = Master(synchronised=known)
    master.ingest.no_response()
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    master.ingest.no_response()
    assert master.synchronise(20_000, AHEAD_NS + 500 * MS).measurements == []


@pytest.mark.parametrize(("silent_ms", "let_go"), [(300, False), (600, True)])
def test_held_measurement_before_a_pause_for_a_restart_is_dropped(
    silent_ms: int,
    let_go: bool,  # noqa: FBT001
) -> None:
    """Without polls no request can be lost, but the station may have restarted."""
    master = Master(synchronised=False)
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    found = master.synchronise(8000 + silent_ms + 1000 + 110, AHEAD_NS + 40 * MS)
    assert (found.measurements == []) == let_go


def test_held_error_of_an_ambiguous_clock_has_no_time() -> None:
    """It is stamped with its arrival: 11 ms apart, both clocks explain it."""
    master = Master()
    master.ingest.no_response()
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS, status=3, distance_m=-1.0))
    master.ingest.no_response()
    (measurement,) = master.synchronise(9000, AHEAD_NS + 11 * MS).measurements
    assert measurement.stamp_ns == START + 8000 * MS
    assert measurement.stamp_sigma_ns == UNTIMED_SIGMA_NS


def test_held_measurement_of_the_same_clock_is_released() -> None:
    """After lost requests too."""
    master = Master()
    master.ingest.no_response()
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    master.ingest.no_response()
    assert len(master.synchronise(20_000).measurements) == 1


def test_bound_of_a_held_measurement_covers_a_small_step() -> None:
    """A station with a late stamp may have stepped by as much."""
    master, step_ns = Master(synchronised=False), 5 * MS
    master.synchronise(0, late_ns=5 * MS)
    master.ingest.no_response()
    held = message(START + 23_000 * MS + AHEAD_NS)
    assert master.poll(23_200, held).needs_synchronisation
    master.ingest.no_response()
    found = master.synchronise(25_000, AHEAD_NS + step_ns, late_ns=5 * MS)
    assert not found.record.restarted
    (measurement,) = found.measurements
    truths_ns = START + 23_000 * MS, START + 23_000 * MS - step_ns
    assert measurement.stamp_bound_ns is not None
    for truth_ns in truths_ns:
        assert abs(measurement.stamp_ns - truth_ns) <= measurement.stamp_bound_ns
        assert abs(measurement.stamp_ns - truth_ns) <= 3 * measurement.stamp_sigma_ns


def test_replayed_message_is_ignored() -> None:
    """The next genuine one is used."""
    master = Master()
    old = message(START + 750 * MS + AHEAD_NS)
    master.poll(1000, old)
    master.poll(1600, message(START + 1400 * MS + AHEAD_NS))
    assert master.poll(9000, old) == (None, False, False)
    assert master.poll(9600, message(START + 9400 * MS + AHEAD_NS)).measurement is not None


def test_restart_suspends_the_clock() -> None:
    """The station had measured, and now has no measurement yet."""
    master = Master()
    master.poll(1000, message(START + 750 * MS + AHEAD_NS))
    assert master.poll(1600, no_measurement_yet(1)) == (None, False, True)
    assert master.poll(2200, message(START + 2000 * MS + AHEAD_NS - 100 * MS)) == (None, False, False)
    found = master.synchronise(3500, AHEAD_NS - 100 * MS)
    assert found.stepped
    (measurement,) = found.measurements
    assert measurement.stamp_ns == pytest.approx(START + 2000 * MS, abs=MS)


def test_restart_without_a_measurement_needs_a_lost_request() -> None:
    """Restart without a measurement needs a lost request."""
    master = Master()
    assert master.poll(1000, no_measurement_yet(1)) == (None, False, False)
    master.ingest.no_response()
    assert master.poll(1600, no_measurement_yet(1)) == (None, False, True)
    master.synchronise(3000)
    assert master.poll(3600, no_measurement_yet(1)) == (None, False, False)


def test_papers_filter_is_reset_after_a_restart() -> None:
    """At a tenth of the error per synchronisation it would need an hour."""
    master = Master()
    master.ingest = StationIngest(1, 4, clock_filter("paper"))
    master.synchronise(0)
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response()
    assert master.poll(21_200, message(START + 1200 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(23_000, AHEAD_NS - 20 * SECOND)
    assert found.stepped
    assert found.record.offset_ns == pytest.approx(AHEAD_NS - 20 * SECOND, abs=MS)


def test_papers_filter_is_reset_after_a_step() -> None:
    """Papers filter is reset after a step."""
    master = Master()
    master.ingest = StationIngest(1, 4, clock_filter("paper"))
    master.synchronise(0)
    ahead_ns = AHEAD_NS + 3600 * SECOND
    assert master.poll(1000, message(START + 800 * MS + ahead_ns)).stepped
    found = master.synchronise(2500, ahead_ns)
    assert found.record.restarted
    assert found.record.offset_ns == pytest.approx(ahead_ns, abs=MS)


def test_bound_includes_the_stamp_delay() -> None:
    """Bound includes the stamp delay."""
    plain, late = Master(synchronised=False), Master(synchronised=False)
    late.ingest = StationIngest(1, 4, clock_filter("regression"), 700_000)
    bounds = [master.synchronise(0).record.bound_ns for master in (plain, late)]
    assert bounds[1] - bounds[0] == 700_000


def test_first_measurement_after_none_is_held() -> None:
    """The station may have restarted in between, with a slightly different clock."""
    master = Master()
    master.poll(1000, no_measurement_yet(1))
    first = master.poll(1600, message(START + 1300 * MS + AHEAD_NS + 30 * MS))
    assert first.measurement is None
    assert first.needs_synchronisation
    (measurement,) = master.synchronise(3000, AHEAD_NS + 30 * MS).measurements
    assert measurement.stamp_ns == pytest.approx(START + 1300 * MS, abs=MS)
    assert master.poll(3600, message(START + 3300 * MS + AHEAD_NS + 30 * MS)).measurement is not None


def in_state(state: ClockState) -> Master:
    """Return a station in a state, its last reply at 0 ms."""
    master = Master(synchronised=state is not ClockState.UNSYNCHRONISED)
    if state is ClockState.AWAITING_MEASUREMENT:
        master.poll(0, no_measurement_yet(1))
    elif state is ClockState.SUSPENDED:
        master.ingest.suspend()
    assert master.ingest.state is state
    return master


def cause(master: Master, event: ClockEvent) -> None:
    """Let the station do what causes an event, 1 s later."""
    match event:
        case ClockEvent.SYNCHRONISATION:
            master.synchronise(1500)
        case ClockEvent.NO_MEASUREMENT_YET:
            master.poll(1000, no_measurement_yet(1))
        case ClockEvent.POSSIBLE_RESTART:
            master.ingest.suspend()
        case ClockEvent.IMPOSSIBLE_TIMESTAMP:
            master.poll(1000, message(START + 3600 * SECOND + AHEAD_NS))


UNSYNCHRONISED, SYNCHRONISED, AWAITING, SUSPENDED = ClockState
TRANSITIONS = {
    ClockEvent.SYNCHRONISATION: [SYNCHRONISED, SYNCHRONISED, SYNCHRONISED, SYNCHRONISED],
    ClockEvent.NO_MEASUREMENT_YET: [UNSYNCHRONISED, AWAITING, AWAITING, SUSPENDED],
    ClockEvent.POSSIBLE_RESTART: [UNSYNCHRONISED, SUSPENDED, SUSPENDED, SUSPENDED],
    ClockEvent.IMPOSSIBLE_TIMESTAMP: [UNSYNCHRONISED, UNSYNCHRONISED, UNSYNCHRONISED, SUSPENDED],
}
"""By event, the next state from each state in the order of the enum."""


@pytest.mark.parametrize("event", ClockEvent)
@pytest.mark.parametrize("state", ClockState)
def test_clock_state_transitions(state: ClockState, event: ClockEvent) -> None:
    """Each event leads from each state to the state of the table, also when a station causes it."""
    expected = TRANSITIONS[event][list(ClockState).index(state)]
    assert next_clock_state(state, event) is expected
    master = in_state(state)
    cause(master, event)
    assert master.ingest.state is expected


@pytest.mark.parametrize("state", ClockState)
def test_measurements_are_published_while_synchronised_only(state: ClockState) -> None:
    """In every other state they are held; a first measurement also suspends the clock."""
    master = in_state(state)
    result = master.poll(1000, message(START + 750 * MS + AHEAD_NS))
    assert (result.measurement is not None) == (state is SYNCHRONISED)
    assert result.needs_synchronisation == (state is AWAITING)
    assert master.ingest.state is (SUSPENDED if state is AWAITING else state)
    released = master.synchronise(2500).measurements
    assert len(released) == (state is not SYNCHRONISED)
