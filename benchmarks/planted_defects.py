"""Would the checkers see a defect? Defects planted in the program one by one, and which check or test finds each.

    python benchmarks/planted_defects.py [NAMES ...] [--seeds N]

A defect is a wrong function in the place of a right one, for as long as its missions run and are checked: nothing is
edited, and the checkers run with the defect, as they would if it were in the program. Each runs short simulated
missions with the faults that make it show, one seed after the other, until a checker sees it. Where no checker can, as
nobody in the simulation is clever enough to make use of it, a test is run with the defect instead. Ends with 3 when one is
not found.
"""

# ruff: noqa: SLF001 (a defect sits where nobody else looks)

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import subprocess
import sys
import tempfile
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, Literal

import pytest

from tsgt.config import ScenarioConfig
from tsgt.config.radio import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.errors import RadioError, StreamError
from tsgt.log import configure_logging
from tsgt.master import continuous_poses, intake, observations, stream, superframe_link, tracks
from tsgt.master.clock_line import Line
from tsgt.master.disk import Disk
from tsgt.model import Status
from tsgt.radio import session_keeper, superframe_master
from tsgt.radio.inbox import Inbox
from tsgt.radio.messages import TIME_UNIT_US
from tsgt.radio.outbox import Delivery
from tsgt.radio.peer import Peer
from tsgt.radio.station_session import StationSession
from tsgt.radio.superframe_station import SuperframeStation
from tsgt.recording.writer import RecordingWriter
from tsgt.simulation import mission as mission_module
from tsgt.simulation.checkers import violations
from tsgt.simulation.faults import QUICK_CYCLES, FaultKind
from tsgt.simulation.options import Options
from tsgt.simulation.scenario import simulate
from tsgt.station import backlog, daemon
from tsgt.station import superframe_link as station_link
from tsgt.station.leica_times import InstrumentTimes

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from tsgt.simulation.mission import Mission

TESTS = Path(__file__).parents[1] / "tests"

SEEDS = 8
"""So many missions at most."""


class Planting:
    """Puts wrong things in the place of right ones, and the right ones back."""

    def __init__(self) -> None:
        self._before: list[tuple[Any, str, Any]] = []

    def put(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace an attribute by what is made of it."""
        right = owner.__dict__[name]
        self._before.append((owner, name, right))
        setattr(owner, name, make(right))

    def undo(self) -> None:
        """Put everything back."""
        while self._before:
            setattr(*self._before.pop())


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
    protocol, estimator, duration_s
        Of the missions.
    script
        Runs beside the daemons.
    test
        A test that sees it, below ``tests``, where no checker can.
    """

    name: str
    plant: Callable[[Planting], None]
    faults: tuple[FaultKind, ...] = ()
    protocol: Literal["superframe", "classic"] = "superframe"
    estimator: Literal["linear", "continuous"] = "linear"
    duration_s: float = 60.0
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


# --- Acknowledgements -----------------------------------------------------------------------------------------


def no_acknowledgement(planting: Planting) -> None:
    """Never tell a station what is in the recording."""
    planting.put(Peer, "history", lambda _: lambda _peer, _counter: 0)
    planting.put(Inbox, "cumulative", lambda _: property(lambda _inbox: -1))


def acknowledged_before_written(planting: Planting) -> None:
    """Take everything for written that has come."""

    def settle(link: Any) -> None:
        while link._unwritten:
            reply = link._unwritten.popleft()
            link._master.peer(reply.station).inbox.written(reply.sequences)

    planting.put(superframe_link.SuperframeLink, "_settle", lambda _: settle)


def acknowledged_to_the_highest(planting: Planting) -> None:
    """Acknowledge what is missing below the highest number."""
    planting.put(Inbox, "cumulative", lambda _: property(lambda inbox: inbox._written.highest))


def deleted_when_sent(planting: Planting) -> None:
    """Delete what is on the air, whether it arrives or not."""

    def sent(right: Any) -> Any:
        def wrong(delivery: Any, sequences: Any) -> None:
            right(delivery, sequences)
            delivery._outbox.remove(sequences)

        return wrong

    planting.put(Delivery, "sent", sent)


def repeats_kept(planting: Planting) -> None:
    """Hand on whatever comes."""

    def take(right: Any) -> Any:
        return lambda inbox, number: right(inbox, number) or True

    planting.put(Inbox, "take", take)


def repeats_kept_classic(planting: Planting) -> None:
    """Know nothing of what has come before."""

    def init(right: Any) -> Any:
        def wrong(station: Any, *arguments: Any) -> None:
            right(station, *arguments)
            station._known = deque(maxlen=0)

        return wrong

    planting.put(intake._Station, "__init__", init)


# --- Numbers and codes ----------------------------------------------------------------------------------------


def numbers_again(planting: Planting) -> None:
    """Begin with number 0 after each start."""

    def read(right: Any) -> Any:
        return lambda *arguments: replace(right(*arguments), run_start=0, queued=())

    planting.put(daemon, "read_backlog", read)


def nonce_again(planting: Planting) -> None:
    """Introduce a station to each session with the same nonce."""

    def init(right: Any) -> Any:
        def wrong(keeper: Any, *arguments: Any) -> None:
            right(keeper, *arguments)
            keeper._random_bits = lambda _bits: 7

        return wrong

    planting.put(session_keeper.SessionKeeper, "__init__", init)


def code_not_compared(planting: Planting) -> None:
    """Take each code for the right one, at the master and at the stations."""
    anything = SimpleNamespace(compare_digest=lambda _one, _other: True)
    for module in (superframe_master, session_keeper):
        planting.put(module, "hmac", lambda _: anything)


def old_beacon_accepted(planting: Planting) -> None:
    """Find the frame number of a beacon that is not new."""

    def counter_of(session: Any, beacon: Any) -> int | None:
        newest = session.heard.counter
        if beacon.session is None:
            return max(newest + (beacon.frame - newest + 128) % 256 - 128, 0)
        counter = beacon.session.counter_high << 8 | beacon.frame
        return counter if beacon.session.nonce == session.master_nonce else None

    planting.put(StationSession, "counter_of", lambda _: counter_of)


# --- Time -----------------------------------------------------------------------------------------------------


def offset_added(planting: Planting) -> None:
    """Add the offset of a station's clock instead of taking it off."""

    def measurement(right: Any) -> Any:
        def wrong(station: Any, message: Any, received_ns: int) -> Any:
            stamped = right(station, message, received_ns)
            return replace(stamped, stamp_ns=2 * message.time_ns - stamped.stamp_ns)

        return wrong

    planting.put(intake._Station, "_measurement", measurement)


def frequency_reversed(planting: Planting) -> None:
    """Carry a clock's offset on with the frequency's wrong sign."""

    def at_ns(line: Any, station_ns: int) -> int:
        return int(line.base_ns + round(line.offset_ns - line.frequency * line._seconds(station_ns)))

    planting.put(Line, "at_ns", lambda _: at_ns)


def beacon_beside(planting: Planting) -> None:
    """Take the time at which a beacon left for that of the beacon after it."""

    def reception(right: Any) -> Any:
        def wrong(session: Any) -> Any:
            found = right(session)
            return found and replace(found, received_ns=session.heard.received_ns)

        return wrong

    planting.put(StationSession, "reception", reception)


def slot_beside(planting: Planting) -> None:
    """Reply a slot too late."""

    def slot_of(right: Any) -> Any:
        def wrong(station: Any, session: Any) -> Any:
            slot = right(station, session)
            if slot is None:
                return None
            late_ns = slot.span.end_ns - slot.span.start_ns + session.timing.guard_ns
            span = slot.span._replace(
                start_ns=slot.span.start_ns + late_ns, end_ns=slot.span.end_ns + late_ns
            )
            return slot._replace(span=span, start_ns=slot.start_ns + late_ns)

        return wrong

    planting.put(SuperframeStation, "_slot_of", slot_of)


def whole_milliseconds(planting: Planting) -> None:
    """Round the time of a measurement down to whole milliseconds."""
    units = 1000 // TIME_UNIT_US

    def timed(right: Any) -> Any:
        def wrong(*arguments: Any) -> Any:
            found = right(*arguments)
            return found and found._replace(time=found.time // units * units)

        return wrong

    planting.put(StationSession, "timed", timed)


def latency_left_in(planting: Planting) -> None:
    """Leave the instrument's latency in the stamps."""

    def stamp(right: Any) -> Any:
        def wrong(times: Any, measured: Any) -> Any:
            found = right(times, measured)
            return found and found._replace(at_ns=found.at_ns + times.latency_ns)

        return wrong

    planting.put(InstrumentTimes, "stamp", stamp)


# --- Values ---------------------------------------------------------------------------------------------------


def angle_short_of_a_bit(planting: Planting) -> None:
    """Leave the lowest bit of the angles out."""
    for module in (backlog, station_link):
        planting.put(module, "angle_code", lambda right: lambda angle_rad: right(angle_rad) & ~1)


def other_calibration(planting: Planting) -> None:
    """Let the master have station 2's frame of before somebody moved it by 20 mm."""

    def run_master(right: Any) -> Any:
        def wrong(config: Any, parameters: Any, *arguments: Any, **named: Any) -> Any:
            first, station, *others = parameters.stations
            row, *rows = station.T_station1_station
            moved = replace(station, T_station1_station=((*row[:3], row[3] + 0.02), *rows))
            parameters = replace(parameters, stations=(first, moved, *others))
            return right(config, parameters, *arguments, **named)

        return wrong

    planting.put(mission_module, "run_master", run_master)


def no_prism_constant(planting: Planting) -> None:
    """Leave the prism constant out."""

    def corrected(right: Any) -> Any:
        return lambda distance_m, *, constant_m, ppm: right(distance_m, constant_m=0 * constant_m, ppm=ppm)

    for module in (tracks, observations):
        planting.put(module, "corrected_distance", corrected)


def error_used(planting: Planting) -> None:
    """Use a measurement whatever its instrument says of it."""
    planting.put(Status, "usable", lambda _: property(lambda _status: True))


# --- Poses ----------------------------------------------------------------------------------------------------


def covariance_a_quarter(planting: Planting) -> None:
    """State a quarter of the covariance."""

    def ros_covariance(right: Any) -> Any:
        return lambda *arguments: right(*arguments) / 4

    planting.put(continuous_poses, "ros_covariance", ros_covariance)


def smoothed_now(planting: Planting) -> None:
    """Stamp smoothed poses with the time at which they are made."""

    def smoothed(right: Any) -> Any:
        def wrong(poses: Any, stamp_ns: Any, *arguments: Any) -> Any:
            batch = right(poses, stamp_ns, *arguments)
            return replace(batch, stamp_ns=batch.stamp_ns + poses._limits.lag_ns)

        return wrong

    planting.put(continuous_poses.ContinuousPoses, "smoothed", smoothed)


# --- Files, queues, radios ------------------------------------------------------------------------------------


def another_order(planting: Planting) -> None:
    """Let each fiftieth line change places with the next one on its way to the disk."""
    held: dict[Any, bytes] = {}

    def put(right: Any) -> Any:
        def wrong(disk: Any, line: bytes) -> None:
            if disk not in held and disk.taken % 50 == 49:
                held[disk] = line
                return
            right(disk, line)
            if disk in held:
                right(disk, held.pop(disk))

        return wrong

    planting.put(Disk, "put", put)


def journalled_afterwards(planting: Planting) -> None:
    """Deliver at once, and write half a second later."""

    def measured(client: Any, reading: Any) -> None:
        measurement = client._session.measured(reading, client._timeline.unix_ns(reading.at_ns))
        client.link.offer(measurement)
        asyncio.get_running_loop().call_later(0.5, client.write, measurement)

    planting.put(daemon._Client, "_measured", lambda _: measured)


def torn_line_kept(planting: Planting) -> None:
    """Go on behind half a line."""
    planting.put(RecordingWriter, "_cut_torn_line", lambda _: lambda _writer: None)


def endless_queue(planting: Planting) -> None:
    """Let lines wait for a slow reader without a bound."""
    planting.put(stream._Reader, "full", lambda _: property(lambda _reader: False))


async def sleeping_reader(mission: Mission) -> None:
    """Connect to the stream and read nothing, to the end."""
    await mission.sleep_until(2.0)
    _, writer = await asyncio.open_unix_connection(mission.stream_socket())
    await mission.sleep_until(124.0)
    writer.transport.abort()


def radio_given_up(planting: Planting) -> None:
    """Use a station's radio until its first fault, and never again."""

    async def keep_radio(open_radio: Any, use: Any, _clock: Any) -> None:
        with contextlib.suppress(RadioError, StreamError):
            async with open_radio() as radio:
                await use(radio)
        await asyncio.Event().wait()

    planting.put(daemon, "keep_radio", lambda _: keep_radio)


F: Final = FaultKind
_YESTERDAY = (
    "unit/radio/test_held_back.py::test_a_session_of_yesterday_played_to_a_station_that_was_just_started"
)
_ERROR_STATUS = "unit/master/test_pipeline.py::test_an_error_status_is_named_as_the_reason"

DEFECTS: Final = {
    key: defect
    for key, defect in {
        "no-ack": Defect("the master acknowledges nothing", no_acknowledgement, (F.LOSS,), duration_s=70),
        "ack-early": Defect(
            "the master acknowledges what is not written yet",
            acknowledged_before_written,
            (F.DISK_FULL, F.MASTER_CRASH),
            duration_s=150,
        ),
        "ack-highest": Defect(
            "the master acknowledges all up to the highest number",
            acknowledged_to_the_highest,
            (F.LOSS,),
            duration_s=80,
        ),
        "deleted": Defect("a station deletes what it has sent", deleted_when_sent, (F.LOSS,), duration_s=80),
        "repeats": Defect("the master hands on repeats", repeats_kept, (F.DISK_FULL,), duration_s=100),
        "repeats-classic": Defect(
            "the master does not know repeats, classic",
            repeats_kept_classic,
            (F.LOSS,),
            protocol="classic",
            duration_s=80,
        ),
        "numbers": Defect(
            "a station begins with number 0 again", numbers_again, (F.CLIENT_CRASH,), duration_s=80
        ),
        "nonce": Defect("a station has one nonce for all sessions", nonce_again, test=_YESTERDAY),
        "code": Defect("the code of a packet is not compared", code_not_compared),
        "old-beacon": Defect("an old beacon is accepted", old_beacon_accepted, (F.FORGERY,), duration_s=80),
        "offset": Defect("the clock's offset is added, classic", offset_added, protocol="classic"),
        "frequency": Defect(
            "the clock's frequency is reversed, classic", frequency_reversed, protocol="classic"
        ),
        "beacon": Defect("a beacon's time is taken for that of the next", beacon_beside),
        "slot": Defect("a station replies in the slot after its own", slot_beside, (F.LOSS,), duration_s=80),
        "whole-ms": Defect("times are cut to whole milliseconds", whole_milliseconds),
        "latency": Defect("the instrument's latency is left in", latency_left_in),
        "angle": Defect("angles are cut by a bit", angle_short_of_a_bit),
        "calibration": Defect("a station's frame is 20 mm off", other_calibration),
        "calibration-continuous": Defect("the same, continuous", other_calibration, estimator="continuous"),
        "constant": Defect("the prism constant is left out", no_prism_constant),
        "constant-continuous": Defect("the same, continuous", no_prism_constant, estimator="continuous"),
        "error": Defect("a measurement with an error status is used", error_used, test=_ERROR_STATUS),
        "covariance": Defect(
            "the covariance is too small by 4", covariance_a_quarter, estimator="continuous"
        ),
        "smoothed": Defect(
            "smoothed poses have the time of predicted ones", smoothed_now, estimator="continuous"
        ),
        "order": Defect("the recording has another order than the stream", another_order),
        "journal": Defect(
            "a measurement is delivered before it is written",
            journalled_afterwards,
            (F.CLIENT_CRASH,),
            duration_s=100,
        ),
        "torn": Defect("half a line is not cut off", torn_line_kept, (F.DISK_FULL,), duration_s=100),
        "queue": Defect(
            "a reader's queue has no bound", endless_queue, script=sleeping_reader, duration_s=122
        ),
        "radio": Defect("a station gives its radio up", radio_given_up, (F.CHIP_HANG,), duration_s=100),
    }.items()
}


def hunt(defect: Defect, seeds: int = SEEDS) -> Found:
    """Run missions with a defect until a checker sees it."""
    found = Found()
    plain = ScenarioConfig()
    pipeline = plain.pipeline.model_copy(update={"estimator": defect.estimator})
    scenario = plain.model_copy(update={"pipeline": pipeline})
    protocol = (
        SuperframeMasterConfig(kind="superframe")
        if defect.protocol == "superframe"
        else ClassicMasterConfig(kind="classic", initial_cycles=QUICK_CYCLES)
    )
    planting = Planting()
    for seed in range(seeds):
        options = Options(
            duration_s=defect.duration_s, seed=seed, protocol=protocol, faults=frozenset(defect.faults)
        )
        found.simulated_s += defect.duration_s
        with tempfile.TemporaryDirectory(prefix="tsgt-planted-") as folder:
            try:
                defect.plant(planting)
                run = simulate(scenario, options, folder=Path(folder), script=defect.script)
                seen = violations(run)
            except Exception as error:  # noqa: BLE001 (a daemon or a checker that falls over is seen as well)
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


def fails(key: str) -> bool:
    """Whether a defect's test passes without it and fails with it, each time in a process of its own."""
    planted = f"import planted_defects as p; p.DEFECTS[{key!r}].plant(p.Planting())"
    run = f"import sys, pytest; sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', {str(TESTS / DEFECTS[key].test)!r}]))"
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
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


def main(names: Sequence[str] = (), seeds: int = SEEDS, *, verbose: bool = False) -> int:
    """Print the table; return 3 if something was not found."""
    configure_logging("critical")
    logging.disable(logging.CRITICAL)  # asyncio's, of daemons that are killed
    print("| defect | protocol, estimator | faults | seen by | after, s |\n|---|---|---|---|---|")
    missed = 0
    for key in names or DEFECTS:
        defect = DEFECTS[key]
        if defect.test:
            seen = f"`{defect.test}`" if fails(key) else ""
            print(f"| {defect.name} | | | {seen or '**nothing**'} | |", flush=True)
        else:
            found = hunt(defect, seeds)
            seen = ", ".join(sorted(found.checks))
            print(
                f"| {defect.name} | {defect.protocol}, {defect.estimator} | {', '.join(defect.faults)} | "
                f"{seen or '**nothing**'} | {found.simulated_s:g} |",
                flush=True,
            )
            if verbose:
                print(f"    {dict(found.checks)} {found.example[:300]}", flush=True)
        missed += not seen
    return 3 if missed else 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*DEFECTS, []], help="which (default: all)")
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, help=f"missions of each at most (default: {SEEDS})"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="also the first violation of each")
    arguments = parser.parse_args()
    sys.exit(main(arguments.names, arguments.seeds, verbose=arguments.verbose))
