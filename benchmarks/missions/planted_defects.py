"""Would the checkers see a defect? Defects planted in the program one by one, and which check or test finds each.

    python benchmarks/run.py planted_defects [NAMES ...] [--seeds N] [--from FILE]

A defect is a wrong function in the place of a right one, for as long as its missions run and are checked: nothing is
edited, and the checkers run with the defect, as they would if it were in the program. Each runs short simulated
missions with the faults that make it show, one seed after the other, until a checker sees it. Where no checker can, as
nobody in the simulation is clever enough to make use of it, a test is run with the defect instead. Ends with 3 when one is
not found.

Those in `independent_defects.py` run as well. `--from` takes the defects from another file, a Python module with a dictionary ``DEFECTS`` like the one below;
docs/explanation/faults.md has an example.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import inspect
import logging
import os
import runpy
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import pytest
from harness.missions import defects, defects_published
from harness.missions.defects import Planting

from tsgt.config import ClassicMasterConfig, ScenarioConfig, SuperframeMasterConfig
from tsgt.log import configure_logging
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import FAST_SYNC_CYCLES, FaultKind
from tsgt.simulation.mission import MASTER, station_name
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import with_stations

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from tsgt.config import ImuModelName
    from tsgt.simulation.mission import Mission

BENCHMARKS = Path(__file__).parents[1]
TESTS = BENCHMARKS.parent / "tests"

INDEPENDENT = Path(__file__).with_name("independent_defects.py")

SEEDS = 8
"""Missions per defect at most."""


@dataclass(frozen=True, slots=True)
class Defect:
    """Something wrong.

    Attributes
    ----------
    name
        What is wrong.
    plant
        Does it.
    faults
        Kinds of faults with which it shows.
    protocol, estimator, duration_s, drift_ppm, imu, stations
        Of the missions. Fewer than three stations need an IMU.
    script
        Runs while the daemons run.
    test
        A test that sees it, below ``tests``, where no checker can.
    """

    name: str
    plant: Callable[[Planting], None]
    faults: tuple[FaultKind, ...] = ()
    protocol: Literal["superframe", "classic"] = "superframe"
    estimator: Literal["linear", "continuous"] = "linear"
    duration_s: float = 60.0
    drift_ppm: float = 10.0
    imu: ImuModelName = "none"
    stations: int = 3
    script: Callable[[Mission], Coroutine[None, None, None]] | None = None
    test: str = ""


@dataclass(slots=True)
class Found:
    """What has come of a defect.

    Attributes
    ----------
    checks
        How many violations of each check.
    example
        The first of them.
    simulated_s
        How long it took to see it, checked missions as a whole.
    """

    checks: Counter[str] = field(default_factory=Counter)
    example: str = ""
    simulated_s: float = 0.0


async def killed_with_a_full_disk(mission: Mission) -> None:
    """Kill the master while its disk takes nothing."""
    disk = mission.computers[MASTER].disk
    await mission.sleep_until(20.0)
    disk.fail_writes(errno.ENOSPC, 20 * 10**9, 27 * 10**9)
    await mission.sleep_until(25.0)
    await mission.crash(MASTER, down_s=2.0)
    disk.write_error = None


async def silent_station(mission: Mission) -> None:
    """Leave station 2 without radio contact for half a minute."""
    for at_s, attenuation_db in ((20.0, 300.0), (50.0, 0.0)):
        await mission.sleep_until(at_s)
        mission.air.link.set_attenuation(MASTER, station_name(2), attenuation_db)


async def turned_tripod(mission: Mission) -> None:
    """Turn the tripod of station 2 by 2 mrad."""
    await mission.sleep_until(15.0)
    mission.move_station(2, (0.0, 0.0, 0.0), 0.002)


async def sleeping_reader(mission: Mission) -> None:
    """Connect to the stream and read nothing, to the end."""
    await mission.sleep_until(2.0)
    _, writer = await asyncio.open_unix_connection(mission.stream_socket())
    await mission.sleep_until(124.0)
    writer.transport.abort()


F: Final = FaultKind
_YESTERDAY = (
    "unit/radio/superframe/test_delayed_beacons.py::test_replayed_session_does_not_confirm_new_station"
)
_BEACONS = "unit/radio/superframe/test_delayed_beacons.py::test_single_delayed_beacon_is_rejected"
_ERROR_STATUS = "unit/estimation/test_linear.py::test_error_status_is_the_reason"

DEFECTS: Final = {
    "no-ack": Defect("the master acknowledges nothing", defects.never_acknowledge, (F.LOSS,), duration_s=70),
    "ack-early": Defect(
        "the master acknowledges measurements before they are written",
        defects.acknowledge_before_written,
        script=killed_with_a_full_disk,
    ),
    "ack-highest": Defect(
        "the master acknowledges everything up to the highest number",
        defects.acknowledge_up_to_highest,
        (F.LOSS,),
        duration_s=80,
    ),
    "deleted": Defect(
        "a station deletes what it has sent", defects.dequeue_when_sent, (F.LOSS,), duration_s=80
    ),
    "repeats": Defect(
        "the master passes on duplicates", defects.accept_duplicates, script=killed_with_a_full_disk
    ),
    "repeats-classic": Defect(
        "the master does not recognise duplicates, classic",
        defects.accept_duplicates_classic,
        (F.LOSS,),
        protocol="classic",
        duration_s=80,
    ),
    "numbers": Defect(
        "a station restarts its sequence numbers at 0",
        defects.reuse_sequence_numbers,
        (F.CLIENT_CRASH,),
        duration_s=80,
    ),
    "nonce": Defect("a station has one nonce for all sessions", defects.reuse_nonce, test=_YESTERDAY),
    "code": Defect("the code of a packet is not compared", defects.skip_authentication),
    "old-beacon": Defect("an old beacon is accepted", defects.accept_old_beacon, (F.FORGERY,), duration_s=80),
    "offset": Defect("the clock's offset is added, classic", defects.add_clock_offset, protocol="classic"),
    "frequency": Defect(
        "the clock's frequency is reversed, classic",
        defects.reverse_frequency,
        protocol="classic",
        duration_s=120,
        drift_ppm=50,
    ),
    "beacon": Defect(
        "a beacon's time is taken for that of the next", defects.use_time_of_next_beacon, test=_BEACONS
    ),
    "slot": Defect(
        "a station replies in the slot after its own", defects.reply_one_slot_late, (F.LOSS,), duration_s=80
    ),
    "whole-ms": Defect("times are truncated to whole milliseconds", defects.truncate_times_to_ms),
    "latency": Defect("the instrument's latency is not subtracted", defects.keep_instrument_latency),
    "angle": Defect("angles lose their lowest bit", defects.drop_lowest_angle_bit),
    "calibration": Defect("a station's frame is 20 mm off", defects.use_stale_station_frame),
    "calibration-continuous": Defect(
        "the same, continuous", defects.use_stale_station_frame, estimator="continuous"
    ),
    "constant": Defect("the prism constant is omitted", defects.ignore_prism_constant),
    "constant-continuous": Defect(
        "the same, continuous", defects.ignore_prism_constant, estimator="continuous"
    ),
    "error": Defect(
        "a measurement with an error status is used", defects.use_failed_measurements, test=_ERROR_STATUS
    ),
    "covariance": Defect(
        "the covariance is too small by 4", defects.quarter_covariance, estimator="continuous"
    ),
    "smoothed": Defect(
        "smoothed poses carry the time of predicted ones",
        defects.stamp_smoothed_poses_now,
        estimator="continuous",
    ),
    "order": Defect("the recording has another order than the stream", defects.reorder_lines),
    "journal": Defect(
        "a measurement is delivered before it is written",
        defects.journal_after_delivery,
        (F.CLIENT_CRASH,),
        duration_s=100,
    ),
    "torn": Defect("half a line is not cut off", defects.keep_torn_line, (F.DISK_FULL,), duration_s=100),
    "late-5ms": Defect(
        "`continuous` takes one station 5 ms late",
        defects_published.date_station_late(0.005),
        estimator="continuous",
    ),
    "late-20ms": Defect(
        "`continuous` takes one station 20 ms late",
        defects_published.date_station_late(0.020),
        estimator="continuous",
    ),
    "covariance-large": Defect(
        "the covariance is too large by 4", defects_published.quadruple_covariance, estimator="continuous"
    ),
    "digit": Defect("a recorded pose differs in its last digit", defects_published.record_other_digit),
    "lost-classic": Defect(
        "every fiftieth polled measurement is lost, classic",
        defects_published.lose_polled_measurement,
        protocol="classic",
    ),
    "mirrored": Defect("horizontal angles have the wrong sign", defects_published.mirror_horizontal_angles),
    "mirrored-continuous": Defect(
        "the same, continuous", defects_published.mirror_horizontal_angles, estimator="continuous"
    ),
    "swapped": Defect("the lever arms of two prisms are swapped", defects_published.swap_prisms),
    "swapped-continuous": Defect(
        "the same, continuous", defects_published.swap_prisms, estimator="continuous"
    ),
    "acknowledged": Defect(
        "acknowledgements are not journalled", defects_published.never_journal_acknowledgements
    ),
    "count-valid": Defect("the status counts all poses as valid", defects_published.count_all_poses_as_valid),
    "age": Defect("the ages in the poses are 0", defects_published.publish_age_zero),
    "age-continuous": Defect(
        "the same, continuous", defects_published.publish_age_zero, estimator="continuous"
    ),
    "skipped-line": Defect("readers do not get every line", defects_published.skip_streamed_line),
    "velocity": Defect("velocities have the wrong sign", defects_published.reverse_velocities),
    "epoch": Defect("epochs are left out", defects_published.skip_epoch),
    "heard": Defect(
        "the time of the last packet is that of the first", defects_published.keep_first_packet_time
    ),
    "lost-event": Defect(
        "a lost station is no event", defects_published.report_no_lost_station, script=silent_station
    ),
    "layout-event": Defect(
        "a tripod that was turned is no event", defects_published.report_no_layout, script=turned_tripod
    ),
    "nothing-outstanding": Defect(
        "nothing is outstanding by the status",
        defects_published.state_nothing_outstanding,
        script=silent_station,
        duration_s=80,
    ),
    "queue": Defect(
        "a reader's queue has no bound", defects.unbound_reader_queue, script=sleeping_reader, duration_s=122
    ),
    "radio": Defect(
        "a station gives its radio up", defects.never_reopen_radio, (F.CHIP_HANG,), duration_s=100
    ),
}


def hunt(defect: Defect, seeds: int = SEEDS) -> Found:
    """Run missions with a defect until a checker sees it."""
    found = Found()
    plain = ScenarioConfig()
    pipeline = plain.pipeline.model_copy(update={"estimator": defect.estimator})
    robot = plain.imu.model_copy(update={"model": defect.imu})
    scenario = plain.model_copy(update={"pipeline": pipeline, "imu": robot})
    if defect.stations < len(scenario.stations):
        scenario = with_stations(scenario, defect.stations)
    protocol = (
        SuperframeMasterConfig(kind="superframe")
        if defect.protocol == "superframe"
        else ClassicMasterConfig(kind="classic", initial_cycles=FAST_SYNC_CYCLES)
    )
    planting = Planting()
    for seed in range(seeds):
        options = SimulationOptions(
            duration_s=defect.duration_s,
            drift_ppm=defect.drift_ppm,
            seed=seed,
            protocol=protocol,
            faults=frozenset(defect.faults),
        )
        found.simulated_s += defect.duration_s
        with tempfile.TemporaryDirectory(prefix="tsgt-planted-") as folder:
            try:
                defect.plant(planting)
                run = simulate(scenario, options, folder=Path(folder), script=defect.script)
                seen = check_invariants(run)
            except Exception as error:  # (a daemon or a checker that falls over is seen as well)
                if _is_ours(error, defect):
                    raise
                found.checks["died"] += 1
                found.example = repr(error)
                return found
            finally:
                planting.undo()
        if seen:
            found.checks.update(each.check for each in seen)
            found.example = seen[0].detail
            return found
    return found


def _is_ours(error: BaseException, defect: Defect) -> bool:
    """Whether it is the planting that fell over."""
    if isinstance(error, BaseExceptionGroup):
        return any(_is_ours(each, defect) for each in error.exceptions)
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and frames[-1].filename in (defects.__file__, inspect.getsourcefile(defect.plant))


def read_defects(path: Path) -> dict[str, Defect]:
    """Return the defects of a file."""
    found: dict[str, Defect] = runpy.run_path(str(path))["DEFECTS"]
    return found


def all_defects() -> dict[str, Defect]:
    """Return the defects of this file and the independent ones."""
    return DEFECTS | read_defects(INDEPENDENT)


def fails(key: str, test: str) -> bool:
    """Whether a defect's test passes without it and fails with it, each time in a process of its own."""
    planted = f"from missions import planted_defects as p; p.all_defects()[{key!r}].plant(p.Planting())"
    run = (
        f"import sys, pytest; sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', {str(TESTS / test)!r}]))"
    )
    path = os.pathsep.join([str(BENCHMARKS), str(TESTS), os.environ.get("PYTHONPATH", "")])
    ends = [
        subprocess.run(
            [sys.executable, "-c", f"{first}\n{run}"],
            cwd=TESTS.parent,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL,
            check=False,
        ).returncode
        for first in ("", planted)
    ]
    return ends == [pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED]


def main() -> int:
    """Read the command line, print the table; return 3 if a defect was not detected."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="which (default: all)")
    parser.add_argument("--from", dest="file", type=Path, help="Python file with other defects")
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, help=f"missions of each at most (default: {SEEDS})"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="also the first violation of each")
    arguments = parser.parse_args()
    known = all_defects() if arguments.file is None else read_defects(arguments.file)
    if unknown := set(arguments.names) - set(known):
        parser.error(f"no defect {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    configure_logging("critical")
    logging.disable(logging.CRITICAL)  # asyncio's, of daemons that are killed
    print("| defect | protocol, estimator | faults | seen by | after, s |\n|---|---|---|---|---|")
    missed = 0
    for key in arguments.names or known:
        defect = known[key]
        if defect.test:
            seen = f"`{defect.test}`" if fails(key, defect.test) else ""
            print(f"| {defect.name} | | | {seen or '**nothing**'} | |", flush=True)
        else:
            found = hunt(defect, arguments.seeds)
            seen = ", ".join(sorted(found.checks))
            print(
                f"| {defect.name} | {defect.protocol}, {defect.estimator} | {', '.join(defect.faults)} | "
                f"{seen or '**nothing**'} | {found.simulated_s:g} |",
                flush=True,
            )
            if arguments.verbose:
                print(f"    {dict(found.checks)} {found.example[:300]}", flush=True)
        missed += not seen
    return 3 if missed else 0
