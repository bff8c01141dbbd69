"""Simulated field days with planted faults: which cause the diagnosis names, held-out prediction, and errors within their sigmas.

    python benchmarks/run.py field_days [KINDS] [--seeds 40] [--first 0] [--poses 0] [--output F]
    python benchmarks/run.py field_days --table F...

KINDS: `clean`, a fault, or faults joined by `+`, several separated by commas; by default a clean day, the required faults and all
pairs of them. ``--poses``: seeds per kind for which poses are compared with the truth and held-out prediction is computed,
which takes most of the time. ``--output`` appends a JSON line per day, which ``--table`` reads.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from harness.drives.field_day import FAR_TARGETS, REQUIRED, START_NS, Cause, Kind, calibrated, field_day
from measuring import Stopwatch, normalised_squared

from tsgt.analysis.diagnosis import HELD_OUT, diagnose
from tsgt.analysis.evaluation import held_out_errors
from tsgt.analysis.smoothing import estimate_motion_model, smooth_recording
from tsgt.errors import TsgtError
from tsgt.estimation import build_observations
from tsgt.geometry import invert

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harness.drives.field_day import FieldDay

    from tsgt.analysis.diagnosis import Finding
    from tsgt.estimation import PoseBatch

NOT_A_CAUSE = {HELD_OUT}
CHI_SQUARE_95 = 7.815  # 3 degrees of freedom
EDGE_NS = 2_000_000_000


@dataclass(frozen=True)
class Day:
    """What one day gave; the last three are None where not computed."""

    kinds: tuple[str, ...]
    seed: int
    named: tuple[str, ...]  # planted faults that a finding names, at the right place
    listed: tuple[str, ...]  # those that a finding names or lists as nearly as likely
    causes: tuple[str, ...]  # of all findings, with place
    false: tuple[str, ...]  # findings of what was not planted
    seconds: float
    ratio: float | None = None  # held-out mean of continuous over linear
    within: float | None = None  # share of valid poses whose position error is within the 95 % ellipsoid
    error_mm: float | None = None  # rms of the position error at the robot's origin


def matches(finding: Finding, cause: Cause, *, alternatives: bool = False) -> bool:
    """Whether a finding names a planted fault, or with ``alternatives`` lists it."""
    match cause.kind:
        case Kind.FAR_TARGETS:
            targets = set(finding.where.removeprefix("targets ").removeprefix("target ").split(", "))
            return finding.cause == "targets" and targets == {str(each) for each in FAR_TARGETS}
        case Kind.NOISE:
            return finding.cause == "noise" and "horizontal" in finding.where
        case Kind.LOCK_LOSS | Kind.OUTLIERS:
            return finding.cause == cause.kind
    place = f"{'prism' if cause.kind is Kind.PRISM else 'station'} {cause.number}"
    if finding.cause == cause.kind and finding.where == place:
        return True
    short = {
        Kind.VERTICAL_INDEX: f"vertical index of station {cause.number}",
        Kind.TURNED_TRIPOD: f"station {cause.number} turned",
        Kind.PRISM: f"prism {cause.number}",
        Kind.LATENCY: f"latency of station {cause.number}",
        Kind.SINKING_TRIPOD: f"station {cause.number} sinking",
    }
    return alternatives and short[cause.kind] in finding.alternatives


def run(kinds: Sequence[str], seed: int, *, with_poses: bool) -> Day:
    """Simulate, process and diagnose one day."""
    day = field_day(kinds, seed)
    recording = calibrated(day)
    parameters = recording.parameters
    with Stopwatch() as stopwatch:
        observations, _ = build_observations(parameters, recording.measurements, origin_ns=START_NS)
        motion = estimate_motion_model(observations, parameters.pipeline)
        held_out = held_out_errors(observations, parameters) if with_poses else None
        findings = diagnose(parameters, observations, motion, held_out=held_out).findings
    findings = tuple(each for each in findings if each.cause not in NOT_A_CAUSE)
    named = [c.kind.value for c in day.causes if any(matches(f, c) for f in findings)]
    listed = [c.kind.value for c in day.causes if any(matches(f, c, alternatives=True) for f in findings)]
    false = [f for f in findings if not any(matches(f, c, alternatives=True) for c in day.causes)]
    measured: dict[str, float] = {}
    if held_out is not None:
        measured["ratio"] = held_out["continuous"].statistics.mean / held_out["linear"].statistics.mean
        poses = smooth_recording(recording, path=Path("field-day.jsonl")).poses
        measured["within"], measured["error_mm"] = position_errors(day, poses)
    return Day(
        tuple(kinds),
        seed,
        tuple(named),
        tuple(listed),
        tuple(f"{each.cause}: {each.where}" for each in findings),
        tuple(f"{each.cause}: {each.where}" for each in false),
        stopwatch.cpu_s,
        **measured,
    )


def position_errors(day: FieldDay, poses: PoseBatch) -> tuple[float, float]:
    """Share within the 95 % ellipsoid and rms in mm, of valid poses, in the frame of station 1 at the start of the drive."""
    inside = poses.valid & (poses.stamp_ns > START_NS + EDGE_NS)
    inside &= poses.stamp_ns < START_NS + round(1e9 * day.world.duration_s) - EDGE_NS
    truth = invert(day.frames[1]) @ day.world.pose_at((poses.stamp_ns[inside] - START_NS) / 1e9)
    error_m = poses.position_m[inside] - truth[:, :3, 3]
    squared = normalised_squared(error_m, poses.covariance[inside, :3, :3])
    return float(np.mean(squared <= CHI_SQUARE_95)), 1e3 * float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))


def print_tables(days: Sequence[Day]) -> None:
    """Print the confusion table, and figures per kind."""
    by_kinds: dict[tuple[str, ...], list[Day]] = defaultdict(list)
    for each in days:
        by_kinds[each.kinds].append(each)
    print(
        "| day | days | named | named or listed | days with another cause | held-out ratio (largest) | within 95 % | rms |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for kinds, some in by_kinds.items():
        count, planted = len(some), len(kinds) * len(some)
        named = sum(len(each.named) for each in some) / planted if planted else 1.0
        listed = sum(len(each.listed) for each in some) / planted if planted else 1.0
        false = sum(bool(each.false) for each in some)
        ratios = [each.ratio for each in some if each.ratio is not None]
        within = [each.within for each in some if each.within is not None]
        rms = [each.error_mm for each in some if each.error_mm is not None]
        print(
            f"| {' + '.join(kinds) or 'clean'} | {count} | {f'{named:.0%}' if planted else ''} | {f'{listed:.0%}' if planted else ''} "
            f"| {false} | {f'{np.mean(ratios):.2f} ({max(ratios):.2f})' if ratios else ''} "
            f"| {f'{np.mean(within):.1%}' if within else ''} | {f'{np.mean(rms):.1f} mm' if rms else ''} |"
        )
    print()
    singles = {kinds: some for kinds, some in by_kinds.items() if len(kinds) < 2}
    causes = sorted(
        {cause.split(":")[0] for some in singles.values() for each in some for cause in each.causes}
    )
    print(f"| planted | {' | '.join(causes)} | nothing |")
    print(f"|---|{'---|' * (len(causes) + 1)}")
    for kinds, some in singles.items():
        counts = Counter(name for each in some for name in {cause.split(":")[0] for cause in each.causes})
        nothing = sum(not each.causes for each in some)
        cells = [f"{counts[cause] / len(some):.0%}" if counts[cause] else "" for cause in causes]
        print(
            f"| {kinds[0] if kinds else 'clean'} | {' | '.join(cells)} | {f'{nothing / len(some):.0%}' if nothing else ''} |"
        )
    print(f"\n{len(days)} days, {np.mean([each.seconds for each in days]):.1f} s of CPU each")


def read_days(paths: Sequence[Path]) -> list[Day]:
    """Read what ``--output`` wrote; of a repeated day the last."""
    found: dict[tuple[tuple[str, ...], int], Day] = {}
    for path in paths:
        for line in path.read_text().splitlines():
            fields: dict[str, Any] = json.loads(line)
            fields |= {name: tuple(value) for name, value in fields.items() if isinstance(value, list)}
            day = Day(**fields)
            found[day.kinds, day.seed] = day
    return list(found.values())


def main() -> None:
    """Run days, or print the tables of earlier ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="?")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--poses", type=int, default=0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--table", type=Path, nargs="+")
    chosen = parser.parse_args()
    if chosen.table:
        print_tables(read_days(chosen.table))
        return
    required = [each.value for each in REQUIRED]
    default = ["clean", *required, *map("+".join, combinations(required, 2))]
    days = []
    for name in chosen.kinds.split(",") if chosen.kinds else default:
        kinds = [] if name == "clean" else name.split("+")
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            try:
                day = run(kinds, seed, with_poses=seed - chosen.first < chosen.poses)
            except TsgtError as error:
                print(f"{name} {seed}: {error}", file=sys.stderr)
                continue
            days.append(day)
            print(name, seed, f"{day.seconds:.1f} s", *day.causes, sep="; ", flush=True)
            if chosen.output is not None:
                with chosen.output.open("a") as file:
                    file.write(json.dumps(asdict(day)) + "\n")
    print_tables(days)
