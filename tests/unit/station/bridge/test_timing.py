"""Timestamps of a bridge's measurements: the instrument's times on the computer's clock."""

from __future__ import annotations

import json
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.instruments.bridge import HELLO, measured

from tsgt.recording import decode
from tsgt.station.bridge.messages import HelloLine, MeasurementLine
from tsgt.station.bridge.timing import LineTimestamper, TimestampedLine

if TYPE_CHECKING:
    from collections.abc import Callable

MS = 1_000_000
FASTEST_NS = 20 * MS


def error_ms(reported_ns: Callable[[int], int], seed: int, count: int = 300) -> float:
    """Return the mean error of timestamps in ms, given how the instrument reports its times."""
    random = np.random.default_rng(seed)
    timestamper = LineTimestamper(latency_ns=FASTEST_NS)
    timestamper.program_started(decode(HelloLine, json.dumps(HELLO | {"stamps": "instrument"}).encode()))
    true_ns: dict[float, int] = {}
    errors = []
    for number in range(count):
        at_ns = 10**12 + 400 * MS * number + int(random.integers(0, 50 * MS))
        distance_m = 10.0 + 0.001 * number
        true_ns[distance_m] = at_ns
        record = measured(distance_m, instrument_time_ns=reported_ns(at_ns - 10**11))
        received_ns = at_ns + FASTEST_NS + int(random.uniform(0, 2 * MS))
        line = decode(MeasurementLine, json.dumps(record).encode())
        for stamped in timestamper.push(line, 1, received_ns, together=False):
            assert isinstance(stamped, TimestampedLine)
            assert stamped.line.slope_distance_m is not None
            errors.append((stamped.at_ns - true_ns[stamped.line.slope_distance_m]) / MS)
    assert len(errors) == count
    return fmean(errors[count // 2 :])


def mean_error_ms(reported_ns: Callable[[int], int]) -> float:
    """Return the mean error over six seeds, in ms."""
    return fmean(error_ms(reported_ns, seed) for seed in range(6))


@pytest.mark.parametrize("resolution_ns", [1, 1_000, 100_000])
def test_fractional_milliseconds_get_no_correction(resolution_ns: int) -> None:
    """They were not truncated."""
    assert abs(mean_error_ms(lambda ns: ns // resolution_ns * resolution_ns)) < 0.1


def test_whole_milliseconds_get_half_a_millisecond() -> None:
    """Truncation takes half a ms on average."""
    assert abs(mean_error_ms(lambda ns: ns // MS * MS)) < 0.2


def test_whole_milliseconds_from_float_seconds_are_recognised() -> None:
    """A conversion to floating-point seconds and back is off by some ns."""
    assert mean_error_ms(lambda ns: int(ns // MS / 1e3 * 1e9)) == pytest.approx(
        mean_error_ms(lambda ns: ns // MS * MS), abs=0.01
    )


def test_late_fractional_time_ends_correction() -> None:
    """The first times happened to be whole ones."""
    start_ns = 10**12 - 10**11 + 60 * 400 * MS
    assert abs(mean_error_ms(lambda ns: ns // MS * MS if ns < start_ns else ns // 1_000 * 1_000)) < 0.1


def test_sigma_of_the_mapping_is_stated() -> None:
    """Of times by the instrument's clock: it covers the errors that lines with varying delays leave."""
    errors_ms, sigmas_ms = [], []
    for seed in range(10):
        random = np.random.default_rng(seed)
        timestamper = LineTimestamper(latency_ns=0)
        timestamper.program_started(decode(HelloLine, json.dumps(HELLO | {"stamps": "instrument"}).encode()))
        for number in range(20):
            at_ns = 10**12 + 400 * MS * number
            record = measured(10.0 + number, instrument_time_ns=at_ns)
            line = decode(MeasurementLine, json.dumps(record).encode())
            received_ns = at_ns + int(random.uniform(0, 100 * MS))
            for stamped in timestamper.push(line, 1, received_ns, together=False):
                assert isinstance(stamped, TimestampedLine)
                assert stamped.line.instrument_time_ns is not None
                errors_ms.append((stamped.at_ns - stamped.line.instrument_time_ns) / MS)
                sigmas_ms.append(stamped.sigma_ns / MS)
    assert min(sigmas_ms) > 0.0
    assert np.sqrt(np.mean(np.square(errors_ms))) < 2 * np.sqrt(np.mean(np.square(sigmas_ms)))
