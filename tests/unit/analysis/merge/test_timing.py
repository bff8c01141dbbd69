"""The link delay of delivered measurements, and its bound."""

from __future__ import annotations

from tsgt.analysis.merge.timing import DeliveredTime, MasterTime, link_delay


def _delivered(delay_ns: int, bound_ns: int) -> DeliveredTime:
    """Return a measurement that arrived so late, both of whose times have this bound."""
    return DeliveredTime(delay_ns, bound_ns, MasterTime(0, 0, bound_ns))


def test_bound_of_the_link_delay_has_the_distance_from_the_median() -> None:
    """A delay with a tight bound far from the median bounds the median by its distance, not by its own bound alone."""
    late = _delivered(3_000_000, 1_000)
    assert link_delay([_delivered(1_000_000, 50_000), _delivered(1_010_000, 50_000), late]) == (
        1_010_000,
        100_000,
    )
    assert link_delay([_delivered(1_000_000, 3_000_000), _delivered(1_010_000, 3_000_000), late]) == (
        1_010_000,
        1_992_000,
    )


def test_link_delay_of_one_measurement_has_its_bounds() -> None:
    """Nothing is added where the delays agree."""
    assert link_delay([_delivered(5_000, 40)]) == (5_000, 80)
    assert link_delay([]) is None
