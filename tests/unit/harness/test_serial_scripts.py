"""Two hundred faults between client and instrument: no wrong value, no wrong time, no hang, measuring again in time."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.serial_scripts import Bench, Script, all_scripts, run_script

from tsgt.simulation.instrument import LineFault

if TYPE_CHECKING:
    from tsgt.simulation.instrument import ReportedDistance

SCRIPTS = all_scripts()
KINDS = sorted({script.kind for script in SCRIPTS})


def test_there_are_two_hundred() -> None:
    """Each with a seed of its own."""
    assert len({script.seed for script in SCRIPTS}) == len(SCRIPTS) == 200


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_is_survived(kind: str) -> None:
    """What is given was offered, once, at its time; and measuring goes on within the time stated for the kind."""
    for script in SCRIPTS:
        if script.kind == kind:
            outcome = run_script(script)
            assert outcome.wrong == [], f"seed {script.seed}"
            assert outcome.given > 20


async def _wrong_digits(bench: Bench) -> None:
    for _ in range(300):
        bench.line.faults.script.append(LineFault.WRONG_DIGIT)
        await asyncio.sleep(0.31)


async def _lie_about_time(bench: Bench) -> None:
    real = bench.station.offer

    def offer(result: ReportedDistance) -> None:
        real(result._replace(true_ns=result.true_ns + 10**9))

    bench.station.offer = offer  # type: ignore[method-assign]
    await asyncio.sleep(3.0)


async def _never_again(bench: Bench) -> None:
    bench.line.plugged = False


@pytest.mark.parametrize(
    ("act", "complaint"),
    [(_wrong_digits, "never offered"), (_lie_about_time, "stamped"), (_never_again, "no distance for")],
)
def test_the_judge_is_awake(act: object, complaint: str) -> None:
    """Digits that change without a checksum, stamps beside the truth and endless silence are found."""
    script = replace(Script("", 2, 3.0, _never_again), act=act)  # type: ignore[arg-type]
    assert any(complaint in wrong for wrong in run_script(script).wrong)
