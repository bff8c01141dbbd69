"""Forged packets against the cores of a master and three stations: how many of each kind, and how many had an effect.

Those of an exchange that is under way, at the worst moment, without a radio in between; see ``harness.radio.forgery``.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from harness.radio.forgery import KINDS, forge

from tsgt.radio import LoRaSettings
from tsgt.radio.superframe import FrameTiming

MS = 1_000_000


def main() -> None:
    """Print a row for each kind; fail if a packet had an effect."""
    parser = argparse.ArgumentParser(description="Forged packets against master and stations.")
    parser.add_argument("--packets", type=int, default=1_000_000, help="how many (default a million)")
    parser.add_argument("--seed", type=int, default=0, help="of what is sent (default 0)")
    arguments = parser.parse_args()
    settings = LoRaSettings(frequency_hz=905_000_000, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6)
    timing = FrameTiming.from_tolerances(
        settings, start_jitter_ns=5 * MS, turnaround_ns=8 * MS, clock_error_ppm=100.0
    )
    rng, begun_s = np.random.default_rng(arguments.seed), time.perf_counter()
    result = forge(timing, rng.bytes(32), arguments.packets, rng, per_step=200)
    print("| kind | to stations | accepted | to the master | accepted |")
    print("|---|---|---|---|---|")
    for kind in KINDS:
        cells = [
            str(counts[kind, target])
            for target in ("station", "master")
            for counts in (result.sent, result.accepted)
        ]
        print(f"| {kind} | {' | '.join(cells)} |")
    print()
    print(
        f"{result.sent.total()} packets, {result.accepted.total()} accepted, {result.diverged} frames changed, state "
        f"{'as' if result.same_state else 'not as'} without them; {time.perf_counter() - begun_s:.0f} s"
    )
    if result.accepted.total() or result.diverged or not result.same_state:
        raise SystemExit(1)
