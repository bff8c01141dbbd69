"""The intake: from answers to measurements on the master's clock."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import hypothesis.strategies as st
import pytest
from harness.scene import START
from hypothesis import given
from hypothesis import settings as limits

from tsgt.master.classic import UNTIMED_SIGMA_NS
from tsgt.master.classic.ingest import Ingest
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
    """Exchanges 0.25 s apart, the last of which ends at an instant; the station answers so late."""
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
    """Make an answer of station 1."""
    return MeasurementMessage(
        station=1,
        status=status,
        zenith_angle_rad=1.5,
        horizontal_angle_rad=0.5,
        slope_distance_m=distance_m,
        time_ns=time_ns,
    )


def failure(status: int) -> MeasurementMessage:
    """Make the answer of an authors' node that reports an error."""
    return replace(
        message(0, status=status), zenith_angle_rad=-1.0, horizontal_angle_rad=-1.0, slope_distance_m=-1.0
    )


class Master:
    """One station's intake, polled at instants that count from the start, in ms."""

    def __init__(self, *, synchronised: bool = True) -> None:
        self.ingest = Ingest({1: 4}, lambda: clock_filter("regression"))
        if synchronised:
            self.synchronise(0)

    def synchronise(self, at_ms: int, ahead_ns: int = AHEAD_NS, *, late_ns: int = 0) -> SynchronisationResult:
        """Take a synchronisation whose last exchange ends at an instant."""
        at_ns = START + at_ms * MS
        return self.ingest.synchronised(1, samples(at_ns, ahead_ns, late_ns=late_ns), at_ns)

    def poll(self, at_ms: int, answer: MeasurementMessage) -> PollResult:
        """Take an answer that has been received at an instant, 194 ms after the request for it began."""
        received_ns = START + at_ms * MS
        return self.ingest.reply(answer, requested_ns=received_ns - 194 * MS, received_ns=received_ns)


def test_a_measurement_is_put_on_the_masters_clock() -> None:
    """Its stamp is the host's less what the station is ahead; everything raw is kept."""
    result = Master().poll(1000, message(START + 750 * MS + AHEAD_NS))
    assert not result.stepped
    measurement = result.measurement
    assert measurement is not None
    assert measurement.stamp_ns == pytest.approx(START + 750 * MS, abs=20_000)
    assert measurement.host_time_ns == START + 750 * MS + AHEAD_NS
    assert (measurement.station, measurement.prism, measurement.sequence) == (1, 4, 0)
    assert measurement.received_ns == START + 1000 * MS
    assert 0 < measurement.stamp_sigma_ns < MS


def test_a_repeat_is_no_measurement() -> None:
    """The same station time again is the same measurement."""
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
def test_before_its_first_measurement_a_station_says_nothing(answer: MeasurementMessage) -> None:
    """Time 0 is no time, whatever the status."""
    result = Master().poll(1000, answer)
    assert result == (None, False, False)


def test_an_error_without_a_time_is_told_once_until_it_changes() -> None:
    """It is stamped with its result, very uncertain, and never taken for a sign of another clock."""
    master = Master()
    results = [master.poll(1000 * n, failure(status)) for n, status in enumerate((1, 1, 2, 2, 2, 1), start=1)]
    told = [result.measurement for result in results if result.measurement is not None]
    assert [m.status for m in told] == [Status.TILT, Status.WRONG_DISTANCE, Status.TILT]
    assert [m.stamp_ns - START for m in told] == [1000 * MS, 3000 * MS, 6000 * MS]
    assert {m.stamp_sigma_ns for m in told} == {UNTIMED_SIGMA_NS}
    assert {m.slope_distance_m for m in told} == {None}
    assert not any(result.stepped for result in results)


def test_an_error_with_a_wild_time_is_one_without() -> None:
    """The time field of an authors' node that reports an error means nothing."""
    master = Master()
    master.poll(500, message(START + 250 * MS + AHEAD_NS))
    result = master.poll(1000, replace(failure(3), time_ns=12_345 * SECOND))
    assert result.measurement is not None
    assert result.measurement.stamp_ns == START + 1000 * MS
    assert not result.stepped


def test_an_error_with_a_good_time_is_stamped_with_it() -> None:
    """Our clients stamp errors as they stamp everything."""
    result = Master().poll(1000, message(START + 800 * MS + AHEAD_NS, status=1))
    assert result.measurement is not None
    assert result.measurement.status is Status.TILT
    assert result.measurement.stamp_ns == pytest.approx(START + 800 * MS, abs=20_000)


@pytest.mark.parametrize("step_s", [3600, 0.4, -3.0, -1e6, -1.6e9])
def test_after_a_step_measurements_wait_for_the_new_clock(step_s: float) -> None:
    """The first that cannot be says so, once; then all come in their order, with the new clock."""
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
    assert master.ingest.clock(1, START + 3000 * MS) is None
    found = master.synchronise(4500, AHEAD_NS + step_ns)
    assert found.record.restarted
    assert not found.stepped  # it has been told
    assert [round((m.stamp_ns - START) / MS) for m in found.measurements] == list(made_ms)
    assert [m.sequence for m in found.measurements] == [1, 2, 3]
    assert master.poll(5000, message(START + 4900 * MS + AHEAD_NS + step_ns)).measurement is not None


def test_a_step_that_only_a_synchronisation_can_see_is_told_by_it() -> None:
    """20 ms could as well be the way; the next synchronisation finds them."""
    master = Master()
    assert master.poll(1000, message(START + 750 * MS + AHEAD_NS + 5 * MS)).measurement is not None
    found = master.synchronise(30_000, AHEAD_NS + 20 * MS)
    assert found.stepped
    assert found.record.restarted


def test_the_clock_line_says_what_was_found() -> None:
    """Offset at its stamp, with the raw exchanges."""
    found = Master(synchronised=False).synchronise(0)
    assert found.measurements == []
    assert found.record.offset_ns == pytest.approx(AHEAD_NS, abs=20_000)
    assert found.record.samples == tuple(samples(START))
    assert (found.record.filter, found.record.restarted, found.record.rejected) == ("regression", True, 0)


def test_before_the_first_synchronisation_measurements_wait() -> None:
    """None is lost, and none is stamped by guess."""
    master = Master(synchronised=False)
    assert master.poll(1000, message(START + 750 * MS + AHEAD_NS)) == (None, False, False)
    (measurement,) = master.synchronise(2300).measurements
    assert measurement.stamp_ns == pytest.approx(START + 750 * MS, abs=20_000)


def test_a_measurement_without_distance_has_none() -> None:
    """Distance 0 stands for none."""
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
def test_no_message_can_break_it(answers: list[bytes | None]) -> None:
    """Whatever 34 bytes say, and whenever a synchronisation comes: measurements have instants that clocks show."""
    master = Master()
    for number, answer in enumerate(answers, start=1):
        if answer is None:
            for measurement in master.synchronise(number * 1000).measurements:
                assert measurement.stamp_ns >= 0
            continue
        decoded = decode_reply(answer)
        if isinstance(decoded, MeasurementMessage):
            master.poll(number * 1000, decoded)


def test_a_station_that_was_silent_is_synchronised_before_it_is_believed() -> None:
    """A clock that stood still while the station was off makes new measurements look old: they wait."""
    master = Master()
    assert master.poll(1000, message(START + 700 * MS + AHEAD_NS)).measurement is not None
    master.ingest.no_response(1)
    off_ns = 20 * SECOND  # its clock went on from where it was when the power went
    back = master.poll(21_200, message(START + 21_000 * MS - off_ns + AHEAD_NS))
    assert back.measurement is None
    assert back.needs_synchronisation
    assert not back.stepped
    found = master.synchronise(22_500, AHEAD_NS - off_ns)
    assert found.stepped
    (measurement,) = found.measurements
    assert measurement.stamp_ns == pytest.approx(START + 21_000 * MS, abs=MS)


def test_a_station_that_was_only_not_asked_is_believed_at_once() -> None:
    """While others are synchronised nobody asks it: that is no silence of its own."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    later = master.poll(30_000, message(START + 29_800 * MS + AHEAD_NS))
    assert later.measurement is not None
    assert not later.needs_synchronisation


def test_after_a_silence_the_same_clock_is_not_called_another_one() -> None:
    """The synchronisation agrees with what was known, so what waited is let go and nothing is announced."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response(1)
    assert master.poll(21_200, message(START + 21_000 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(23_000)
    assert not found.stepped
    assert [m.stamp_ns for m in found.measurements] == [pytest.approx(START + 21_000 * MS, abs=MS)]


def test_a_backward_step_while_nothing_new_was_measured_is_noticed() -> None:
    """Repeats say that nothing was measured before them, so an older measurement cannot come after."""
    master = Master()
    same = message(START + 700 * MS + AHEAD_NS)
    for at_ms in (1000, 1600, 2200, 2800):
        master.poll(at_ms, same)
    assert master.poll(3400, message(START + 3200 * MS + AHEAD_NS - 1500 * MS)).stepped


def test_a_clock_that_stood_still_while_nobody_asked_is_doubted() -> None:
    """Others were synchronised meanwhile, and no request was lost: what looks old waits for a synchronisation."""
    master = Master()
    off_ns = 15 * SECOND
    back = master.poll(15_200, message(START + 15_000 * MS - off_ns + AHEAD_NS))
    assert back == (None, False, True)
    (measurement,) = master.synchronise(16_500, AHEAD_NS - off_ns).measurements
    assert measurement.stamp_ns == pytest.approx(START + 15_000 * MS, abs=MS)


@pytest.mark.parametrize("step_s", [6.0, -6.0, 1e8, -1e8, 3e9])
def test_what_was_held_before_a_restart_gets_no_time_of_the_clock_after_it(step_s: float) -> None:
    """Nobody knows when it was; the station's journal has it."""
    master = Master()
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response(1)
    assert master.poll(8000, message(START + 7800 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(20_000, AHEAD_NS + round(step_s * 1e9) if step_s < 1e9 else AHEAD_NS - START)
    assert found.stepped
    assert found.measurements == []


@pytest.mark.parametrize("known", [True, False])
def test_what_was_held_while_the_station_may_have_got_another_clock_is_let_go(known: bool) -> None:  # noqa: FBT001
    """Half a second apart, both clocks explain it; only without a lost request it is certain which one it is of."""
    master = Master(synchronised=known)
    master.ingest.no_response(1)
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    master.ingest.no_response(1)
    assert master.synchronise(20_000, AHEAD_NS + 500 * MS).measurements == []


@pytest.mark.parametrize(("silent_ms", "let_go"), [(300, False), (600, True)])
def test_what_was_held_before_a_pause_that_is_long_enough_for_a_restart_is_let_go(
    silent_ms: int,
    let_go: bool,  # noqa: FBT001
) -> None:
    """While others were asked no request could be lost, and the program may have been started again all the same."""
    master = Master(synchronised=False)
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    found = master.synchronise(8000 + silent_ms + 1000 + 110, AHEAD_NS + 40 * MS)
    assert (found.measurements == []) == let_go


def test_an_error_that_was_held_while_the_station_may_have_got_another_clock_has_no_time() -> None:
    """It is told, but with the time of its result: 11 ms apart, the clock that was found explains it just as well."""
    master = Master()
    master.ingest.no_response(1)
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS, status=3, distance_m=-1.0))
    master.ingest.no_response(1)
    (measurement,) = master.synchronise(9000, AHEAD_NS + 11 * MS).measurements
    assert measurement.stamp_ns == START + 8000 * MS
    assert measurement.stamp_sigma_ns == UNTIMED_SIGMA_NS


def test_what_was_held_is_used_if_the_clock_is_the_same_after_lost_requests() -> None:
    """The clock that was known goes on: there is but one that it can be of."""
    master = Master()
    master.ingest.no_response(1)
    master.poll(8000, message(START + 7800 * MS + AHEAD_NS))
    master.ingest.no_response(1)
    assert len(master.synchronise(20_000).measurements) == 1


def test_what_was_held_may_be_of_the_clock_before_or_of_the_one_after_a_small_step() -> None:
    """A station that answers late may have stepped by as much, unnoticed: the bound contains both."""
    master, step_ns = Master(synchronised=False), 5 * MS
    master.synchronise(0, late_ns=5 * MS)
    master.ingest.no_response(1)
    held = message(START + 23_000 * MS + AHEAD_NS)
    assert master.poll(23_200, held).needs_synchronisation
    master.ingest.no_response(1)
    found = master.synchronise(25_000, AHEAD_NS + step_ns, late_ns=5 * MS)
    assert not found.record.restarted
    (measurement,) = found.measurements
    truths_ns = START + 23_000 * MS, START + 23_000 * MS - step_ns
    assert measurement.stamp_bound_ns is not None
    for truth_ns in truths_ns:
        assert abs(measurement.stamp_ns - truth_ns) <= measurement.stamp_bound_ns
        assert abs(measurement.stamp_ns - truth_ns) <= 3 * measurement.stamp_sigma_ns


def test_what_is_played_back_is_no_measurement_and_no_step() -> None:
    """An answer of before, received again, is known; the station's own next one is taken as ever."""
    master = Master()
    old = message(START + 750 * MS + AHEAD_NS)
    master.poll(1000, old)
    master.poll(1600, message(START + 1400 * MS + AHEAD_NS))
    assert master.poll(9000, old) == (None, False, False)
    assert master.poll(9600, message(START + 9400 * MS + AHEAD_NS)).measurement is not None


def test_a_station_that_begins_anew_is_doubted() -> None:
    """It had measured, and now has no measurement yet: its program was started again, with whatever clock."""
    master = Master()
    master.poll(1000, message(START + 750 * MS + AHEAD_NS))
    assert master.poll(1600, no_measurement_yet(1)) == (None, False, True)
    assert master.poll(2200, message(START + 2000 * MS + AHEAD_NS - 100 * MS)) == (None, False, False)
    found = master.synchronise(3500, AHEAD_NS - 100 * MS)
    assert found.stepped
    (measurement,) = found.measurements
    assert measurement.stamp_ns == pytest.approx(START + 2000 * MS, abs=MS)


def test_a_station_that_begins_anew_once_more_is_doubted_once_more() -> None:
    """There was no measurement in between, but a request was lost; without that, one that has none is left alone."""
    master = Master()
    assert master.poll(1000, no_measurement_yet(1)) == (None, False, False)
    master.ingest.no_response(1)
    assert master.poll(1600, no_measurement_yet(1)) == (None, False, True)
    master.synchronise(3000)
    assert master.poll(3600, no_measurement_yet(1)) == (None, False, False)


def test_the_papers_filter_begins_anew_after_a_restart() -> None:
    """A tenth of the way each time, it would need an hour to get there."""
    master = Master()
    master.ingest = Ingest({1: 4}, lambda: clock_filter("paper"))
    master.synchronise(0)
    master.poll(1000, message(START + 700 * MS + AHEAD_NS))
    master.ingest.no_response(1)
    assert master.poll(21_200, message(START + 1200 * MS + AHEAD_NS)).needs_synchronisation
    found = master.synchronise(23_000, AHEAD_NS - 20 * SECOND)
    assert found.stepped
    assert found.record.offset_ns == pytest.approx(AHEAD_NS - 20 * SECOND, abs=MS)


def test_the_papers_filter_begins_anew_after_a_step_that_a_measurement_has_shown() -> None:
    """The next mean is taken whole."""
    master = Master()
    master.ingest = Ingest({1: 4}, lambda: clock_filter("paper"))
    master.synchronise(0)
    ahead_ns = AHEAD_NS + 3600 * SECOND
    assert master.poll(1000, message(START + 800 * MS + ahead_ns)).stepped
    found = master.synchronise(2500, ahead_ns)
    assert found.record.restarted
    assert found.record.offset_ns == pytest.approx(ahead_ns, abs=MS)


def test_a_stamp_that_is_late_by_an_average_may_be_off_by_as_much() -> None:
    """The bound says so."""
    plain, late = Master(synchronised=False), Master(synchronised=False)
    late.ingest = Ingest({1: 4}, lambda: clock_filter("regression"), {1: 700_000})
    bounds = [master.synchronise(0).record.bound_ns for master in (plain, late)]
    assert bounds[1] - bounds[0] == 700_000


def test_the_first_measurement_after_nothing_waits_for_a_synchronisation() -> None:
    """Between the two the station's program may have been started again, with a clock a little off."""
    master = Master()
    master.poll(1000, no_measurement_yet(1))
    first = master.poll(1600, message(START + 1300 * MS + AHEAD_NS + 30 * MS))
    assert first.measurement is None
    assert first.needs_synchronisation
    (measurement,) = master.synchronise(3000, AHEAD_NS + 30 * MS).measurements
    assert measurement.stamp_ns == pytest.approx(START + 1300 * MS, abs=MS)
    assert master.poll(3600, message(START + 3300 * MS + AHEAD_NS + 30 * MS)).measurement is not None
