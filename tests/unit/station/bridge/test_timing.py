"""When a bridge's measurements were made: the instrument's times on the computer's clock."""

from __future__ import annotations

import json
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.bridge import HELLO, measured

from tsgt.recording import decode
from tsgt.station.bridge.messages import HelloLine, MeasurementLine
from tsgt.station.bridge.timing import LineTimestamper, TimestampedLine

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
FASTEST_NS = 20 * MS


def error_ms(told_ns: Callable[[int], int], seed: int, count: int = 300) -> float:
    """Return by how much stamps are after the fastest answer's way, in ms; the instrument tells its times in some form."""
    random = np.random.default_rng(seed)
    stamper = LineTimestamper(latency_ns=FASTEST_NS)
    stamper.program_started(decode(HelloLine, json.dumps(HELLO | {"stamps": "instrument"}).encode()))
    true_ns: dict[float, int] = {}
    errors = []
    for number in range(count):
        at_ns = 10**12 + 400 * MS * number + int(random.integers(0, 50 * MS))
        distance_m = 10.0 + 0.001 * number
        true_ns[distance_m] = at_ns
        told = measured(distance_m, instrument_time_ns=told_ns(at_ns - 10**11))
        arrived_ns = at_ns + FASTEST_NS + int(random.uniform(0, 2 * MS))
        line = decode(MeasurementLine, json.dumps(told).encode())
        for stamped in stamper.push(line, 1, arrived_ns, together=False):
            assert isinstance(stamped, TimestampedLine)
            assert stamped.line.slope_distance_m is not None
            errors.append((stamped.at_ns - true_ns[stamped.line.slope_distance_m]) / MS)
    assert len(errors) == count
    return fmean(errors[count // 2 :])


def mean_error_ms(told_ns: Callable[[int], int]) -> float:
    """Return the mean of some runs, in ms."""
    return fmean(error_ms(told_ns, seed) for seed in range(6))


@pytest.mark.parametrize("told_to_ns", [1, 1_000, 100_000])
def test_nothing_is_added_to_times_that_are_told_finer_than_in_ms(told_to_ns: int) -> None:
    """Nothing of them was cut off that could be missing."""
    assert abs(mean_error_ms(lambda ns: ns // told_to_ns * told_to_ns)) < 0.1


def test_half_a_ms_is_added_to_whole_ones() -> None:
    """They were cut off, half a ms on average."""
    assert abs(mean_error_ms(lambda ns: ns // MS * MS)) < 0.2


def test_whole_ms_that_went_through_seconds_are_still_whole_ones() -> None:
    """A program that has its times as a floating-point number of seconds is off by some ns when it multiplies."""
    assert mean_error_ms(lambda ns: int(ns // MS / 1e3 * 1e9)) == pytest.approx(
        mean_error_ms(lambda ns: ns // MS * MS), abs=0.01
    )


def test_a_source_that_turns_out_finer_is_told_so_at_once() -> None:
    """Its first times happened to be whole ones; half a ms is not added to those after them."""
    begun = 10**12 - 10**11 + 60 * 400 * MS
    assert abs(mean_error_ms(lambda ns: ns // MS * MS if ns < begun else ns // 1_000 * 1_000)) < 0.1
