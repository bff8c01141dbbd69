"""Faults between client and instrument over TCP: no wrong value or time, no hang, recovery in time."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.instruments.network_scripts import (
    NetworkBench,
    NetworkScript,
    all_network_scripts,
    run_network_script,
)

if TYPE_CHECKING:
    from tsgt.simulation.instrument import ReportedDistance

SCRIPTS = all_network_scripts()
FIRST = {script.kind: script for script in reversed(SCRIPTS)}


def test_there_are_two_hundred_scripts() -> None:
    """Each with a seed of its own."""
    assert len({script.seed for script in SCRIPTS}) == len(SCRIPTS) == 200


@pytest.mark.parametrize("kind", ["connection lost"])
@pytest.mark.slow
def test_fault_of_the_network_is_survived(kind: str) -> None:
    """Every reading was offered, once, at its time within three sigmas; and measuring continues in time."""
    outcome = run_network_script(FIRST[kind])
    assert outcome.violations == []
    assert outcome.reported > 20


@pytest.mark.parametrize("part", range(5))
@pytest.mark.slow
def test_faults_of_the_network_are_survived(part: int) -> None:
    """Every fifth script of all kinds; the benchmark runs them all."""
    for script in SCRIPTS[5 * part :: 25]:
        outcome = run_network_script(script)
        assert outcome.violations == [], f"{script.kind}, seed {script.seed}"
        assert outcome.reported > 20


async def _shift_offered_times(bench: NetworkBench) -> None:
    real = bench.station.report

    def report(result: ReportedDistance) -> None:
        real(result._replace(true_ns=result.true_ns + 30_000_000))

    bench.station.report = report  # type: ignore[method-assign]
    await asyncio.sleep(3.0)


async def _stop_for_ever(bench: NetworkBench) -> None:
    bench.network.faults.half_open = True


@pytest.mark.parametrize(
    ("act", "complaint"),
    [
        pytest.param(_shift_offered_times, "timestamped", marks=pytest.mark.slow),
        (_stop_for_ever, "no distance for"),
    ],
)
def test_violations_of_the_network_are_detected(act: object, complaint: str) -> None:
    """Timestamps that are 30 ms wrong, and endless silence."""
    script = replace(NetworkScript("", 2, 5.0, _stop_for_ever, latency_known=True), act=act)  # type: ignore[arg-type]
    assert any(complaint in violation for violation in run_network_script(script).violations)
