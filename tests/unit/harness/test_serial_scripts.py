"""Two hundred fault injections between client and instrument: no wrong value or time, no hang, recovery in time."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.instruments.serial_scripts import Bench, Script, all_scripts, run_script

from tsgt.simulation.instrument import LineFault

if TYPE_CHECKING:
    from tsgt.simulation.instrument import ReportedDistance

SCRIPTS = all_scripts()
KINDS = sorted({script.kind for script in SCRIPTS})


def test_there_are_two_hundred_scripts() -> None:
    """Each with a seed of its own."""
    assert len({script.seed for script in SCRIPTS}) == len(SCRIPTS) == 200


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_fault_is_survived(kind: str) -> None:
    """Every reading was offered, once, at its time; and measuring continues within the limit of the kind."""
    for script in SCRIPTS:
        if script.kind == kind:
            outcome = run_script(script)
            assert outcome.violations == [], f"seed {script.seed}"
            assert outcome.reported > 20


async def _change_digits(bench: Bench) -> None:
    for _ in range(300):
        bench.line.faults.script.append(LineFault.WRONG_DIGIT)
        await asyncio.sleep(0.31)


async def _shift_offered_times(bench: Bench) -> None:
    real = bench.station.report

    def report(result: ReportedDistance) -> None:
        real(result._replace(true_ns=result.true_ns + 10**9))

    bench.station.report = report  # type: ignore[method-assign]
    await asyncio.sleep(3.0)


async def _unplug_forever(bench: Bench) -> None:
    bench.line.plugged = False


@pytest.mark.parametrize(
    ("act", "complaint"),
    [
        (_change_digits, "never offered"),
        (_shift_offered_times, "timestamped"),
        (_unplug_forever, "no distance for"),
    ],
)
def test_violations_are_detected(act: object, complaint: str) -> None:
    """Changed digits without a checksum, wrong timestamps, and endless silence."""
    script = replace(Script("", 2, 3.0, _unplug_forever), act=act)  # type: ignore[arg-type]
    assert any(complaint in violation for violation in run_script(script).violations)
