"""Two hundred faults between a client and its Leica: what goes wrong, and how soon it measures again.

python benchmarks/run.py serial_faults [KIND]
"""

from __future__ import annotations

import logging
import sys

import structlog
from harness.instruments.serial_scripts import Script, ScriptResult, all_scripts, run_script
from measuring import Stopwatch


def main() -> None:
    """Run the scripts, all or those of a kind; print a line for each kind."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    only = sys.argv[1] if len(sys.argv) > 1 else ""
    scripts = [script for script in all_scripts() if only in script.kind]
    results: dict[str, list[tuple[Script, ScriptResult]]] = {}
    with Stopwatch() as stopwatch:
        for script in scripts:
            results.setdefault(script.kind, []).append((script, run_script(script)))
    print("| fault | scripts | offered | given | wrong | measures again after, median / worst | stated |")
    print("|---|---|---|---|---|---|---|")
    for kind, outcomes in results.items():
        after_s = sorted(outcome.recovery_s for _, outcome in outcomes)
        offered, given = (
            sum(getattr(outcome, name) for _, outcome in outcomes) for name in ("offered", "reported")
        )
        wrong = sum(len(outcome.violations) for _, outcome in outcomes)
        print(
            f"| {kind} | {len(outcomes)} | {offered} | {given} | {wrong} "
            f"| {after_s[len(after_s) // 2]:.1f} / {after_s[-1]:.1f} s | {outcomes[0][0].limit_s:g} s |"
        )
    for kind, outcomes in results.items():
        for script, outcome in outcomes:
            for problem in outcome.violations[:3]:
                print(f"{kind}, seed {script.seed}: {problem}")
    print(f"{len(scripts)} scripts, {stopwatch.cpu_s:.0f} s of CPU")
