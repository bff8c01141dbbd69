"""Compare the output of two source trees byte by byte, apart from renamed keys and reworded messages.

A refactoring must not change behaviour: the same seeds give the same recordings, truth and figures.

    python benchmarks/run.py byte_identity collect --tree OLD_TREE --output OLD --old-names
    python benchmarks/run.py byte_identity collect --tree . --output NEW
    python benchmarks/run.py byte_identity compare OLD NEW

`collect` runs fourteen missions (both protocols, both estimators, faults on and off) and processes and evaluates both
segments of published field data, if they are there. `compare` translates the old names and compares the rest exactly.
Left out are the wording of messages, how long a command took, and when a file was made.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

MISSIONS = {
    "superframe-linear": "dynamic --protocol superframe --estimator linear --duration 120 --seed 1",
    "superframe-continuous": "dynamic --protocol superframe --estimator continuous --duration 120 --seed 2",
    "classic-linear": "dynamic --protocol classic --estimator linear --duration 120 --seed 3",
    "classic-continuous": "dynamic --protocol classic --estimator continuous --duration 120 --seed 4",
    "quarry-faults": "quarry --protocol superframe --estimator continuous --duration 180 --faults all --seed 5",
    "ski-trail-faults": "ski-trail --protocol superframe --estimator linear --duration 180 --faults all --seed 6",
    "snowmobile-faults": "snowmobile --protocol classic --estimator linear --duration 180 --faults all --seed 7",
    "static-faults": "static --protocol classic --estimator continuous --duration 180 --faults all --seed 8",
    "outage-restart": "dynamic --protocol superframe --estimator linear --duration 120 --seed 9 --loss 0.3"
    " --drift-ppm 50 --outage 1,2:40:30 --restart 2:60 --restart master:90",
    "paper-filter": "dynamic --protocol classic --estimator linear --clock-filter paper --duration 240 --seed 10",
    "interference": "dynamic --protocol superframe --estimator linear --duration 90 --seed 11 --unauthenticated"
    " --interference-rate-hz 5 --stamp-jitter-us 50",
    "authors-node": "dynamic --protocol classic --estimator linear --station-software authors --duration 120 --seed 12",
    "four-stations": "dynamic --protocol superframe --estimator continuous --stations 4 --duration 120 --faults all"
    " --seed 13",
    "classic-faults": "dynamic --protocol classic --estimator linear --duration 180 --faults all --seed 14"
    " --drift-ramp-ppm-per-min 2",
}

DAY = Path("20220314")
SEGMENTS = {"segment1": DAY, "segment2": DAY / "segment2"}

OLD_OPTIONS = {
    "--unauthenticated": "--no-key",
    "--interference-rate-hz": "--foreign-per-s",
    "--station-software": "--node",
    "--samples": "--draws",
}

OLD_NAMES = {
    "beacon_doubted": "beacon_time_rejected",
    "link_doubted": "link_delay_anomaly",
    "fence_left": "geofence_exited",
    "fence_entered": "geofence_entered",
    "frame_suspect": "layout_residual_high",
    "frame_restored": "layout_residual_normal",
    "backlog_left_behind": "measurements_discarded",
    "master_not_understood": "no_valid_beacon",
    "person_needed": "operator_required",
    "instrument_time_began_anew": "instrument_clock_reset",
    "turns_stuck": "scheduler_stalled",
    "slot_late": "slot_missed",
    "bridge_said": "bridge_stderr",
    "beacon_refused": "beacon_authentication_failed",
    "request_too_old": "request_expired",
    "station_back": "station_recovered",
    "radio_back": "radio_recovered",
    "residual_per_speed_ms": "residual_speed_gain_ms",
    "turn_round_ms": "turnaround_ms",
    "stamp_delay_ms": "timestamp_delay_ms",
    "narrow_view": "reduced_field_of_view",
    "silence_s": "stall_timeout_s",
    "acceleration_time_s": "acceleration_correlation_time_s",
    "shaking_smoothing_s": "attitude_smoothing_s",
    "left_out_mm": "leave_one_out_mm",
    "node": "station_software",
    "draws": "samples",
    "late": "missed_slots",
    "doubted": "rejected_beacons",
    "too_late": "outside_lag_window",
    "missing": "outstanding",
    "standing": "stationary",
    "undetermined": "unobservable",
    "again": "replay_command",
    "lineage": "stream_id",
    "run_start": "first_sequence",
    "left_out_m": "leave_one_out_m",
    "angular_acceleration_time_s": "angular_acceleration_correlation_time_s",
}
"""Keys and event names that were renamed, old to new."""

VOLATILE = re.compile(
    rb'"(?:message|detail|note|wall_seconds|seconds|created_ns|recording|output|version)": ?(?:"(?:[^"\\]|\\.)*"|[-0-9.e]+|null)'
)


def run(tree: Path, arguments: list[str], stdout: Path, *, old_names: bool) -> None:
    """Run one `tsgt` command of a source tree and keep what it prints."""
    if old_names:
        arguments = [OLD_OPTIONS.get(each, each) for each in arguments]
    environment = dict(os.environ, PYTHONPATH=str(tree), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    done = subprocess.run(
        [sys.executable, "-m", "tsgt", *arguments],
        cwd=tree,
        env=environment,
        capture_output=True,
        check=False,
    )
    stdout.write_bytes(done.stdout)
    print(f"exit {done.returncode}: tsgt {' '.join(arguments)}", flush=True)
    if done.returncode not in {0, 3}:
        print(done.stderr.decode()[-2000:], flush=True)


def collect(tree: Path, output: Path, data: Path, *, old_names: bool) -> None:
    """Run all cases on two cores."""
    output.mkdir(parents=True, exist_ok=True)

    def mission(name: str) -> None:
        files = ["--output", str(output / f"{name}.jsonl"), "--truth", str(output / f"{name}.tum")]
        arguments = ["simulate", *MISSIONS[name].split(), *files, "--json"]
        run(tree, arguments, output / f"{name}.json", old_names=old_names)

    def segment(name: str) -> None:
        folder = data / SEGMENTS[name]
        recording = output / f"{name}.jsonl"
        tracks = [str(folder / f"trimble{number}.csv") for number in (1, 2, 3)]
        day = data / DAY

        def call(suffix: str, *arguments: str) -> None:
            run(tree, [*arguments, "--json"], output / f"{name}.{suffix}.json", old_names=old_names)

        call(
            "import", "import", "rts", "--tracks", *tracks, "--prisms", str(day / "sensor_positions.csv"),
            "--targets", str(day / "GCP.txt"), "--target-constant-mm", "10", "--prism-constant-mm", "10",
            "--output", str(recording),
        )  # fmt: skip
        for estimator in ("linear", "continuous"):
            for suffix in ("tum", "jsonl"):
                poses = output / f"{name}-{estimator}.poses.{suffix}"
                call(
                    f"process-{estimator}-{suffix}", "process", str(recording), "--estimator", estimator,
                    "--output", str(poses),
                )  # fmt: skip
        call("evaluate", "evaluate", str(recording))
        call("motion", "calibrate", "motion", str(recording))

    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(mission, name) for name in MISSIONS]
        if data.is_dir():
            jobs += [pool.submit(segment, name) for name in SEGMENTS]
        for job in jobs:
            job.result()
    targets = data / DAY / "GCP.txt"
    if targets.is_file():
        arguments = ["calibrate", "targets", str(targets), "--target-constant-mm", "10", "--json"]
        run(tree, arguments, output / "targets.json", old_names=old_names)
    arguments = ["analyse", "perturbation", "--step-mm", "40", "--samples", "200", "--json"]
    run(tree, arguments, output / "perturbation.json", old_names=old_names)


def canonical(path: Path, names: dict[str, str]) -> list[bytes]:
    """Return a file's lines with names translated and wording and durations removed."""
    text = path.read_bytes()
    if path.suffix == ".tum":
        return text.splitlines()
    if names:
        for new, old in OLD_OPTIONS.items():
            text = text.replace(f" {old} ".encode(), f" {new} ".encode())
    for old, new in names.items():
        text = text.replace(f'"{old}"'.encode(), f'"{new}"'.encode())
    return [VOLATILE.sub(b"", line) for line in text.splitlines()]


def compare(old: Path, new: Path) -> int:
    """Compare two collections; return the number of files that differ."""
    different = 0
    for path in sorted(old.iterdir()):
        before = canonical(path, OLD_NAMES)
        other = new / path.name
        after = canonical(other, {}) if other.is_file() else []
        equal = before == after
        different += not equal
        print(
            f"{'identical' if equal else 'DIFFERENT'}  {path.name}  {len(before)} lines, {path.stat().st_size} bytes"
        )
        if not equal:
            shown = 0
            for number, (a, b) in enumerate(zip(before, after, strict=False), 1):
                if a != b and shown < 3:
                    shown += 1
                    at = next(
                        (i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b))
                    )
                    print(
                        f"  line {number}\n    old …{a[max(0, at - 80) : at + 120]!r}\n    new …{b[max(0, at - 80) : at + 120]!r}"
                    )
            print(f"  {len(before)} lines before, {len(after)} after")
    print(f"{different} of {len(list(old.iterdir()))} files differ")
    return different


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    collecting = commands.add_parser("collect", help="run all cases with one source tree")
    collecting.add_argument(
        "--tree", type=Path, required=True, help="source tree that holds the package tsgt"
    )
    collecting.add_argument("--output", type=Path, required=True, help="folder for the results")
    collecting.add_argument(
        "--data", type=Path, default=Path("../shared/data/rts"), help="published field data"
    )
    collecting.add_argument(
        "--old-names", action="store_true", help="the tree has the option names of before"
    )
    comparing = commands.add_parser("compare", help="compare two folders of results")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "collect":
        collect(
            arguments.tree.resolve(),
            arguments.output.resolve(),
            arguments.data.resolve(),
            old_names=arguments.old_names,
        )
    else:
        sys.exit(1 if compare(arguments.old, arguments.new) else 0)
