"""Completeness of a station's measurements."""

from tsgt.estimation.completeness import CompletenessTracker

SECOND = 1_000_000_000
LIMIT = 2 * SECOND


def test_measurements_in_order_are_complete_at_once() -> None:
    """Measurements in order are complete at once."""
    arrivals = CompletenessTracker(LIMIT)
    for sequence in range(3):
        arrivals.add(7 + sequence, sequence * SECOND)
    assert arrivals.complete_ns(2 * SECOND) == 2 * SECOND


def test_measurement_after_a_gap_does_not_count() -> None:
    """A missing number may still arrive."""
    arrivals = CompletenessTracker(LIMIT)
    arrivals.add(0, SECOND)
    arrivals.add(2, 3 * SECOND)
    assert arrivals.complete_ns(3 * SECOND) == SECOND


def test_closing_a_gap_completes_what_follows() -> None:
    """Late measurements arrive in any order."""
    arrivals = CompletenessTracker(LIMIT)
    for sequence in (0, 4, 2, 3, 1):
        arrivals.add(sequence, (sequence + 1) * SECOND)
    assert arrivals.complete_ns(5 * SECOND) == 5 * SECOND


def test_gap_ends_at_the_transport_limit() -> None:
    """Of the measurement after it."""
    arrivals = CompletenessTracker(LIMIT)
    arrivals.add(0, SECOND)
    arrivals.add(2, 3 * SECOND)
    arrivals.add(3, 4 * SECOND)
    assert arrivals.complete_ns(3 * SECOND + LIMIT) == SECOND
    assert arrivals.complete_ns(3 * SECOND + LIMIT + 1) == 4 * SECOND


def test_backlog_before_the_first_measurement_is_ignored() -> None:
    """It arrives newest first."""
    arrivals = CompletenessTracker(LIMIT)
    arrivals.add(100, 100 * SECOND)
    arrivals.add(99, 99 * SECOND)
    arrivals.add(101, 101 * SECOND)
    assert arrivals.complete_ns(101 * SECOND) == 101 * SECOND


def test_restarted_numbers_are_followed() -> None:
    """A station that has lost its journal counts from zero."""
    arrivals = CompletenessTracker(LIMIT)
    arrivals.add(500, 10 * SECOND)
    arrivals.add(0, 11 * SECOND)
    arrivals.add(1, 12 * SECOND)
    assert arrivals.complete_ns(12 * SECOND) == 12 * SECOND


def test_gaps_end_with_the_last_one() -> None:
    """Everything up to a time is complete when the measurement after the last gap reaches the transport limit."""
    arrivals = CompletenessTracker(LIMIT)
    for sequence, second in ((0, 1), (2, 3), (3, 4), (5, 6)):
        arrivals.add(sequence, second * SECOND)
    given_up_s = [arrivals.last_gap_end_ns(second * SECOND) for second in (1, 2, 3, 4, 5, 6, 7)]
    assert given_up_s == [None, 3 * SECOND, 3 * SECOND, 3 * SECOND, 6 * SECOND, 6 * SECOND, None]
    assert arrivals.complete_ns(3 * SECOND + LIMIT + 1) == 4 * SECOND
