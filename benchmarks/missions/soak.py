"""Many simulated missions with faults of all kinds, each from one seed, and what must never happen counted in all of them.

    python benchmarks/run.py soak [--minutes M] [--first SEED] [--seeds N] [--jobs J] [--imu MODEL ...] [--odometry] [--stations N ...] [--field-day] [--json FILE]

Protocol, estimator, losses and drifts change from seed to seed, and with them how often which faults come
(`tsgt/simulation/faults/catalogue.py`); with an IMU the rate of the poses, their delays and
which kinds come at all change too, and of several IMUs and numbers of stations each seed has one. With `--field-day` each
mission has two of the kinds beside that come by name only. A replay of the recording
computes all poses a second time: whether it gives the same is checked in a quarter of the missions, drawn by seed, while
`tsgt simulate` always checks it. In a tenth of all missions a reader of the relay
and the page follow the stream, and what they get is compared with it. A line for each violation says how to get the same run again. `make soak` runs it for a
quarter of an hour. With `--json` the sums are kept, and a later call with the same file adds to them and goes on after
the last seed.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from harness.missions.passed_on import PassedOn
from measuring import normalised_squared

from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.estimation.inertial import setup_monitor as imu_setup_monitor
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.log import configure_logging
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import FAST_SYNC_CYCLES, FIELD_DAY_FAULTS, FaultKind
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario, with_stations

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from tsgt.config import ImuModelName
    from tsgt.geometry.inertial_calibration import SetupCheck
    from tsgt.model import ImuSamples, Measurement, Parameters
    from tsgt.simulation.mission import MissionResult

DURATION_S = 220.0
REPLAYED_SHARE = 0.25  # of the missions
PASSED_ON_SHARE = 0.1  # likewise; the relay and the page wake up for every line
STATIONS = 3
FIELD_DAY_KINDS = sorted(
    FIELD_DAY_FAULTS
    - {FaultKind.PRISM_CONSTANT, FaultKind.SECOND_ROBOT, FaultKind.WINDOW}
    - {FaultKind.SAME_STATION, FaultKind.LONG_DISK_FULL}
)
"""Kinds that come by name and violate no invariant. The first three left out make valid poses of `linear` wrong; a client with the number
of another one that is silent at that time is taken for it; the last needs hours."""
FIELD_DAY_COUNT = 2
LIMITS = (22.46, 38.26, 60.0)
"""What squared errors in sigmas, six degrees of freedom, exceed once in a thousand, in a million, in 2e10 honest poses."""

COUNTERS = ("missions", "simulated_s", "cpu_s", "faults", "above", "far", "accused")


@dataclass(frozen=True, slots=True)
class Mission:
    """What a seed stands for."""

    seed: int
    protocol: Literal["superframe", "classic"]
    estimator: Literal["linear", "continuous"]
    loss: float
    drift_ppm: float
    imu: ImuModelName
    stations: int
    rate_hz: float | None  # of the poses; None: that of the scenario
    delayed: bool  # whether there are smooth poses at a delay
    faults: frozenset[FaultKind]  # kinds that may come
    replayed: bool = True  # whether a replay of the recording is checked
    odometry: bool = False  # whether the robot has wheels that are measured, beside the IMU
    passed_on: bool = False  # whether a reader of the relay and the page follow the stream
    field_day: bool = False  # whether kinds may come that otherwise come by name only

    @classmethod
    def of(
        cls,
        seed: int,
        imu: ImuModelName = "none",
        stations: int = STATIONS,
        *,
        odometry: bool = False,
        field_day: bool = False,
    ) -> Mission:
        """Draw it; a quarter of the missions have the continuous estimator, which takes most of the time.

        With an IMU, which `linear` does not use, three quarters have it, and with few stations all.
        """
        rng = np.random.default_rng([seed, 0x50AC])
        continuous = 1.0 if stations < STATIONS else 0.25 if imu == "none" else 0.75
        protocol: Literal["superframe", "classic"] = "superframe" if rng.random() < 0.5 else "classic"
        estimator: Literal["linear", "continuous"] = "continuous" if rng.random() < continuous else "linear"
        # A master with an IMU cannot be suspended in the simulation.
        named = [kind for kind in FIELD_DAY_KINDS if imu == "none" or kind != FaultKind.MASTER_SUSPEND]
        named = np.random.default_rng([seed, 0xF1E1D]).choice(named, FIELD_DAY_COUNT, replace=False).tolist()
        return cls(
            seed,
            protocol,
            estimator,
            # With one packet in ten lost, classic has too few measurements for `linear` even without faults.
            float(rng.choice([0.0, 0.02, 0.1] if protocol == "superframe" else [0.0, 0.02])),
            round(float(rng.uniform(-50, 50)), 1),
            imu,
            stations,
            None if imu == "none" else float(rng.choice([5.0, 10.0, 20.0])),
            imu == "none" or bool(rng.random() < 0.5),
            (frozenset(FaultKind if imu == "none" else _some_kinds(rng)) - FIELD_DAY_FAULTS)
            | frozenset(map(FaultKind, named if field_day else ())),
            bool(rng.random() < REPLAYED_SHARE),
            odometry,
            bool(rng.random() < PASSED_ON_SHARE),
            field_day,
        )

    @property
    def kind(self) -> str:
        """What its sums are kept by."""
        kind = f"{self.protocol}, {self.estimator}"
        return kind if self.imu == "none" else f"{self.imu}, {self.stations} stations, {kind}"

    @property
    def command(self) -> str:
        """The command that runs it again."""
        if self.imu != "none" or self.passed_on or self.field_day:
            more = "--odometry " * self.odometry + "--field-day " * self.field_day
            return (
                f"python benchmarks/run.py soak --imu {self.imu} {more}--stations {self.stations} "
                f"--first {self.seed} --seeds 1 --jobs 1"
            )
        return (
            f"tsgt simulate dynamic --protocol {self.protocol} --duration {DURATION_S:g} --loss {self.loss} "
            f"--drift-ppm {self.drift_ppm} --faults all --estimator {self.estimator} "
            f"--stations {self.stations} --seed {self.seed}"
        )


def _some_kinds(rng: np.random.Generator) -> list[FaultKind]:
    """Draw some: with faults of all kinds the IMU is hardly ever in use, because a drive has to confirm it anew each time."""
    share = float(rng.choice([0.15, 0.4, 1.0]))
    return [kind for kind in FaultKind if rng.random() < share]


@dataclass(slots=True)
class Sums:
    """What has come of many missions.

    Attributes
    ----------
    next_seed
        The first that has not been run.
    missions
        How many, by protocol and estimator.
    simulated_s, cpu_s
        Simulated seconds and seconds of CPU, likewise; checkers included.
    replayed
        Of how many a replay was checked.
    faults
        How many of each kind.
    measurements, poses
        What was delivered, and how many poses were called valid.
    with_imu
        Of these poses, how many rest on the IMU.
    above
        How many valid poses of the continuous estimator exceed each of :data:`LIMITS`, and all of them, by series.
    far
        How many valid poses exceed the largest of them, by seed.
    accused
        How often a station was said to contradict the IMU, by seed: after a change of that, other missions need not be run again.
    violations
        What must not happen and did: how to get it again, and what it was.
    """

    next_seed: int = 0
    missions: Counter[str] = field(default_factory=Counter)
    simulated_s: Counter[str] = field(default_factory=Counter)
    cpu_s: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    replayed: int = 0
    measurements: int = 0
    poses: int = 0
    with_imu: int = 0
    above: Counter[str] = field(default_factory=Counter)
    far: Counter[str] = field(default_factory=Counter)
    accused: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)

    def add(self, other: Sums) -> None:
        """Add those of other missions."""
        for name in COUNTERS:
            getattr(self, name).update(getattr(other, name))
        self.replayed += other.replayed
        self.measurements += other.measurements
        self.poses += other.poses
        self.with_imu += other.with_imu
        self.violations += other.violations
        self.next_seed = max(self.next_seed, other.next_seed)


@contextmanager
def _checked_once() -> Iterator[None]:
    """Compute each check of the IMU's set-up once: the replay of a recording checks the same as the master did.

    Each takes a third of a second. Measurements and samples must be the same to the bit, else it is computed again.
    """
    found: dict[int, SetupCheck] = {}
    compute = imu_setup_monitor.check_recorded_setup

    def check(
        parameters: Parameters, measurements: Iterable[Measurement], records: Iterable[ImuSamples]
    ) -> SetupCheck:
        measurements, records = tuple(measurements), tuple(records)
        key = hash((parameters, measurements, records))
        if key not in found:
            found[key] = compute(parameters, measurements, records)
        return found[key]

    imu_setup_monitor.check_recorded_setup = check
    try:
        yield
    finally:
        imu_setup_monitor.check_recorded_setup = compute


def run(
    seed: int,
    imu: ImuModelName = "none",
    stations: int = STATIONS,
    *,
    odometry: bool = False,
    field_day: bool = False,
) -> Sums:
    """Run a mission and check it."""
    configure_logging("critical")
    logging.disable(logging.CRITICAL)  # asyncio's, of daemons that are killed
    mission = Mission.of(seed, imu, stations, odometry=odometry, field_day=field_day)
    kind = mission.kind
    sums = Sums(next_seed=seed + 1, missions=Counter({kind: 1}), replayed=int(mission.replayed))
    scenario = find_scenario("dynamic")
    if stations < STATIONS:
        scenario = with_stations(scenario, stations)
    changed: dict[str, object] = {"estimator": mission.estimator}
    if mission.rate_hz is not None:
        changed["rate_hz"] = mission.rate_hz
    if not mission.delayed:
        changed["smoothed_delays_s"] = ()
    pipeline = scenario.pipeline.model_copy(update=changed)
    radio = scenario.radio.model_copy(update={"loss_probability": mission.loss})
    robot = scenario.imu.model_copy(update={"model": mission.imu})
    scenario = scenario.model_copy(
        update={"pipeline": pipeline, "radio": radio, "imu": robot, "odometry": odometry}
    )
    options = SimulationOptions(
        duration_s=DURATION_S,
        drift_ppm=mission.drift_ppm,
        seed=seed,
        protocol=SuperframeMasterConfig(kind="superframe")
        if mission.protocol == "superframe"
        else ClassicMasterConfig(kind="classic", initial_cycles=FAST_SYNC_CYCLES),
        faults=mission.faults,
    )
    began_s = time.process_time()
    passed_on = PassedOn()
    with _checked_once(), tempfile.TemporaryDirectory(prefix="tsgt-soak-") as folder:
        Path(folder, "mission").mkdir()
        try:
            done = simulate(
                scenario,
                options,
                folder=Path(folder, "mission"),
                script=partial(passed_on.follow, folder=Path(folder), until_s=DURATION_S)
                if mission.passed_on
                else None,
            )
            violations = check_invariants(done, replay=mission.replayed)
            found = [f"{each.check}: {each.detail}" for each in violations]
            if mission.passed_on:
                found += (f"passed on: {what}" for what in passed_on.failures(done))
            _count(done, sums, str(seed))
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 (whatever it is, it is a finding)
            found = [f"died: {_where(error)}"]
    sums.violations = [f"{mission.command}\n    {each[:400]}" for each in found[:3]]
    sums.simulated_s[kind] = round(DURATION_S)
    sums.cpu_s[kind] = round(1000 * (time.process_time() - began_s))
    return sums


def _where(error: BaseException) -> str:
    """Return the first error of a group, and the last calls before it."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    calls = traceback.extract_tb(error.__traceback__)[-4:]
    return f"{error!r} in " + ", ".join(f"{Path(each.filename).name}:{each.lineno}" for each in calls)


def _count(done: MissionResult, sums: Sums, seed: str) -> None:
    sums.faults.update({str(kind): count for kind, count in done.faults.items()})
    for session in done.master_logs:
        if accused := sum(each.event == "station_contradicted" for each in session.events):
            sums.accused[seed] += accused
        poses = session.valid_poses()
        sums.measurements += len(session.measurements)
        sums.poses += len(poses.stamp_ns)
        sums.with_imu += int(np.count_nonzero(poses.with_imu))
        for series in np.unique(poses.series).tolist():
            some = poses.select(poses.series == series)
            if not len(some.stamp_ns):
                continue
            truth = done.in_force(session).true_poses((some.stamp_ns - session.unix_at_zero_ns) / 1e9)
            turned = rotation_from_quaternion(some.orientation_xyzw) @ np.swapaxes(truth[:, :3, :3], 1, 2)
            errors = np.concatenate([some.position_m - truth[:, :3, 3], log_so3(turned)], axis=1)
            nees = normalised_squared(errors, some.covariance)
            sums.above[f"{series}, all"] += len(nees)
            sums.above[f"{series}, sum"] += round(float(nees.sum()))
            for limit in LIMITS:
                sums.above[f"{series}, above {limit:g}"] += int(np.count_nonzero(nees > limit))
            if far := int(np.count_nonzero(nees > LIMITS[-1])):
                sums.far[seed] += far


def report(sums: Sums) -> None:
    """Print what has come of it."""
    hours = sum(sums.simulated_s.values()) / 3600
    print(
        f"{sum(sums.missions.values())} missions, {hours:.1f} h, {len(sums.violations)} violations listed; "
        f"replay checked in {sums.replayed}"
    )
    for kind in sorted(sums.missions):
        speed = sums.simulated_s[kind] / max(1e-3, sums.cpu_s[kind] / 1000)
        print(
            f"  {kind:45} {sums.missions[kind]:5} missions {sums.simulated_s[kind] / 3600:6.1f} h "
            f"{speed:5.1f} simulated s per s of CPU"
        )
    print(
        f"  {sums.measurements} measurements delivered, {sums.poses} valid poses, {sums.with_imu} of them with the IMU"
    )
    for series in sorted(name.removesuffix(", all") for name in sums.above if name.endswith(", all")):
        if count := sums.above[f"{series}, all"]:
            shares = ", ".join(
                f"{sums.above[f'{series}, above {limit:g}']} above {limit:g}" for limit in LIMITS
            )
            mean = sums.above[f"{series}, sum"] / count
            print(f"  squared errors in sigmas, {series}: mean {mean:.2f} of 6; of {count} poses {shares}")
    if sums.far:
        print(f"  above {LIMITS[-1]:g}: " + ", ".join(f"{n} of seed {seed}" for seed, n in sums.far.items()))
    print("  " + ", ".join(f"{count} {kind}" for kind, count in sorted(sums.faults.items())))


def main() -> int:
    """Run missions for some time, or a number of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=15.0, help="how long (default: 15)")
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--seeds", type=int, help="how many; default: as many as there is time for")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), help="how many at once (default: all cores)"
    )
    parser.add_argument(
        "--imu",
        nargs="+",
        choices=["none", "industrial", "consumer"],
        default=["none"],
        help="the robot's IMU (default: none)",
    )
    parser.add_argument(
        "--stations",
        type=int,
        nargs="+",
        choices=[1, 2, 3],
        default=[STATIONS],
        help="how many; fewer than three with an IMU (default: 3)",
    )
    parser.add_argument("--odometry", action="store_true", help="each robot with an IMU has wheel odometry")
    parser.add_argument(
        "--field-day", action="store_true", help="also two of the kinds of faults that come by name only"
    )
    parser.add_argument("--json", type=Path, help="keep the sums here, and go on from them")
    arguments = parser.parse_args()
    sums = Sums(next_seed=arguments.first)
    if arguments.json is not None and arguments.json.exists():
        kept: dict[str, Any] = json.loads(arguments.json.read_text())
        for name, value in kept.items():
            setattr(sums, name, Counter(value) if name in COUNTERS else value)
    last = None if arguments.seeds is None else sums.next_seed + arguments.seeds
    seed, ends_s, told_s = sums.next_seed, time.monotonic() + 60 * arguments.minutes, time.monotonic()
    # Asked to end, it does not leave its workers behind, but waits for the missions that they are in.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with suppress(KeyboardInterrupt), ProcessPoolExecutor(arguments.jobs, max_tasks_per_child=50) as pool:
        running: set[Future[Sums]] = set()
        while running or (time.monotonic() < ends_s and seed != last):
            while len(running) < arguments.jobs and time.monotonic() < ends_s and seed != last:
                imu = arguments.imu[seed % len(arguments.imu)]
                stations = arguments.stations[seed // len(arguments.imu) % len(arguments.stations)]
                more = {"odometry": arguments.odometry, "field_day": arguments.field_day}
                running.add(pool.submit(run, seed, imu, stations, **more))
                seed += 1
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for each in done:
                found = each.result()
                sums.add(found)
                for violation in found.violations:
                    print(violation, flush=True)
            if time.monotonic() > told_s + 60 and sys.stderr.isatty():
                told_s = time.monotonic()
                print(f"{sum(sums.missions.values())} missions", file=sys.stderr)
            if arguments.json is not None:
                arguments.json.write_text(
                    json.dumps({each.name: getattr(sums, each.name) for each in fields(sums)})
                )
    report(sums)
    return 3 if sums.violations else 0
