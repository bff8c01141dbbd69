"""Planted defects: functions of the program replaced by defective ones for a test or benchmark.

`benchmarks/missions/planted_defects.py` shows which invariants and tests detect them.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter, deque
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from tsgt.errors import RadioError, StreamError
from tsgt.estimation import observations, pose_output, tracks
from tsgt.master import stream_server
from tsgt.master.classic import ingest
from tsgt.master.recording_thread import RecordingThread
from tsgt.master.superframe import link
from tsgt.model import Status
from tsgt.radio.superframe import SuperframeStation, master, station
from tsgt.radio.superframe.receive_window import ReceiveWindow, SequenceSet
from tsgt.radio.superframe.send_queue import DeliveryProgress
from tsgt.radio.superframe.session import StationSession
from tsgt.radio.superframe.wire import TIME_UNIT_US
from tsgt.recording import RecordingWriter
from tsgt.simulation.mission import mission
from tsgt.station import backlog, daemon
from tsgt.station.leica.timing import DistanceTimestamper
from tsgt.station.links import superframe as station_link
from tsgt.timesync.offset_regression import RegressionLine

if TYPE_CHECKING:
    from collections.abc import Callable


class Planting:
    """Replaces attributes by defective ones, and restores them.

    Attributes
    ----------
    replaced
        Owner, name and original of each replaced attribute.
    """

    def __init__(self) -> None:
        self.replaced: list[tuple[Any, str, Any]] = []

    def replace_attribute(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace an attribute by what ``make`` returns for the original."""
        original = owner.__dict__[name]
        self.replaced.append((owner, name, original))
        setattr(owner, name, make(original))

    def undo(self) -> None:
        """Restore all originals."""
        while self.replaced:
            setattr(*self.replaced.pop())


# --- Acknowledgements -----------------------------------------------------------------------------------------


def never_acknowledge(planting: Planting) -> None:
    """Never acknowledge a measurement."""
    planting.replace_attribute(ReceiveWindow, "ack_bitmap", lambda _: lambda _peer, _counter: 0)
    planting.replace_attribute(ReceiveWindow, "cumulative", lambda _: property(lambda _inbox: -1))


def acknowledge_before_written(planting: Planting) -> None:
    """Acknowledge measurements before they are written."""

    def acknowledge(link: Any) -> None:
        while link._unsynced:
            measurement = link._unsynced.popleft()
            link._master.station(measurement.station).window.mark_written([measurement.sequence])

    planting.replace_attribute(link.SuperframeLink, "_acknowledge", lambda _: acknowledge)


def acknowledge_up_to_highest(planting: Planting) -> None:
    """Acknowledge missing sequence numbers below the highest one."""
    planting.replace_attribute(SequenceSet, "cumulative", lambda _: property(lambda numbers: numbers.highest))


def dequeue_when_sent(planting: Planting) -> None:
    """Remove measurements from the queue when they are sent."""

    def sent(original: Any) -> Any:
        def defective(delivery: Any, sequences: Any) -> None:
            original(delivery, sequences)
            delivery._queue.remove(sequences)

        return defective

    planting.replace_attribute(DeliveryProgress, "mark_sent", sent)


def accept_duplicates(planting: Planting) -> None:
    """Deliver duplicates."""

    def take(original: Any) -> Any:
        return lambda window, number: original(window, number) or True

    planting.replace_attribute(ReceiveWindow, "accept", take)


def accept_duplicates_classic(planting: Planting) -> None:
    """Deliver duplicates over protocol classic."""

    def init(original: Any) -> Any:
        def defective(station: Any, *arguments: Any) -> None:
            original(station, *arguments)
            station._known = deque(maxlen=0)

        return defective

    planting.replace_attribute(ingest.StationIngest, "__init__", init)


# --- Numbers and codes ----------------------------------------------------------------------------------------


def reuse_sequence_numbers(planting: Planting) -> None:
    """Start with sequence number 0 after each restart."""

    def read(original: Any) -> Any:
        return lambda *arguments: replace(original(*arguments), first_sequence=0, queued=())

    planting.replace_attribute(daemon, "read_backlog", read)


def reuse_nonce(planting: Planting) -> None:
    """Use the same nonce in each session."""

    def init(original: Any) -> Any:
        def defective(client: Any, *arguments: Any, **named: Any) -> None:
            original(client, *arguments, **named)
            client._random_bits = lambda _bits: 7

        return defective

    planting.replace_attribute(SuperframeStation, "__init__", init)


def skip_authentication(planting: Planting) -> None:
    """Accept every authentication code, at the master and at the stations."""
    anything = SimpleNamespace(compare_digest=lambda _one, _other: True)
    for module in (master, station):
        planting.replace_attribute(module, "hmac", lambda _: anything)


def accept_old_beacon(planting: Planting) -> None:
    """Accept a beacon that is not newer than the last."""

    def counter_of(session: Any, beacon: Any) -> Any:
        newest = session.beacon.counter
        if beacon.session is None:
            return max(newest + (beacon.frame - newest + 128) % 256 - 128, 0)
        counter = beacon.session.counter_high << 8 | beacon.frame
        return counter if beacon.session.nonce == session.master_nonce else None

    planting.replace_attribute(StationSession, "counter_of", lambda _: counter_of)


# --- Time -----------------------------------------------------------------------------------------------------


def add_clock_offset(planting: Planting) -> None:
    """Add a station's clock offset instead of subtracting it."""

    def measurement(original: Any) -> Any:
        def defective(station: Any, message: Any, received_ns: int) -> Any:
            stamped = original(station, message, received_ns)
            return replace(stamped, stamp_ns=2 * message.time_ns - stamped.stamp_ns)

        return defective

    planting.replace_attribute(ingest.StationIngest, "_measurement", measurement)


def reverse_frequency(planting: Planting) -> None:
    """Extrapolate a clock offset with the wrong sign of the frequency."""

    def at_ns(line: Any, station_ns: int) -> int:
        return int(line.base_ns + round(line.line.offset - line.line.skew * line._seconds(station_ns)))

    planting.replace_attribute(RegressionLine, "at_ns", lambda _: at_ns)


def use_time_of_next_beacon(planting: Planting) -> None:
    """Associate a beacon's transmit time with the reception of the next beacon."""

    def reception(original: Any) -> Any:
        def defective(session: Any) -> Any:
            found = original(session)
            return found and replace(found, received_ns=session.beacon.received_ns)

        return defective

    planting.replace_attribute(StationSession, "reception", reception)


def reply_one_slot_late(planting: Planting) -> None:
    """Reply one slot late."""

    def slot_of(original: Any) -> Any:
        def defective(session: Any) -> Any:
            slot = original(session)
            if slot is None:
                return None
            late_ns = slot.slot.end_ns - slot.slot.start_ns + session.timing.guard_ns
            moved = slot.slot._replace(
                start_ns=slot.slot.start_ns + late_ns, end_ns=slot.slot.end_ns + late_ns
            )
            return slot._replace(slot=moved, start_ns=slot.start_ns + late_ns)

        return defective

    planting.replace_attribute(StationSession, "_reply_slot", slot_of)


def truncate_times_to_ms(planting: Planting) -> None:
    """Truncate measurement times to whole milliseconds."""
    units = 1000 // TIME_UNIT_US

    def timed(original: Any) -> Any:
        def defective(*arguments: Any) -> Any:
            found = original(*arguments)
            return found and found._replace(time=found.time // units * units)

        return defective

    planting.replace_attribute(StationSession, "timestamped", timed)


def keep_instrument_latency(planting: Planting) -> None:
    """Do not subtract the instrument's latency."""

    def stamp(original: Any) -> Any:
        def defective(times: Any, measured: Any) -> Any:
            found = original(times, measured)
            return found and found._replace(at_ns=found.at_ns + times.latency_ns)

        return defective

    planting.replace_attribute(DistanceTimestamper, "timestamp", stamp)


# --- Values ---------------------------------------------------------------------------------------------------


def drop_lowest_angle_bit(planting: Planting) -> None:
    """Clear the lowest bit of encoded angles."""
    for module in (backlog, station_link):
        planting.replace_attribute(
            module, "angle_code", lambda original: lambda angle_rad: original(angle_rad) & ~1
        )


def use_stale_station_frame(planting: Planting) -> None:
    """Give the master a frame of station 2 that is wrong by 20 mm."""

    def run_master(original: Any) -> Any:
        def defective(config: Any, parameters: Any, *arguments: Any, **named: Any) -> Any:
            first, station, *others = parameters.stations
            row, *rows = station.T_station1_station
            moved = replace(station, T_station1_station=((*row[:3], row[3] + 0.02), *rows))
            parameters = replace(parameters, stations=(first, moved, *others))
            return original(config, parameters, *arguments, **named)

        return defective

    planting.replace_attribute(mission, "run_master", run_master)


def ignore_prism_constant(planting: Planting) -> None:
    """Do not apply the prism constant."""

    def corrected(original: Any) -> Any:
        return lambda distance_m, *, constant_m, ppm: original(distance_m, constant_m=0 * constant_m, ppm=ppm)

    for module in (tracks, observations):
        planting.replace_attribute(module, "corrected_distance", corrected)


def use_failed_measurements(planting: Planting) -> None:
    """Treat every status as usable."""
    planting.replace_attribute(Status, "usable", lambda _: property(lambda _status: True))


# --- Poses ----------------------------------------------------------------------------------------------------


def quarter_covariance(planting: Planting) -> None:
    """Publish a quarter of the covariance."""

    def ros_covariance(original: Any) -> Any:
        return lambda *arguments: original(*arguments) / 4

    planting.replace_attribute(pose_output, "ros_covariance", ros_covariance)


def stamp_smoothed_poses_now(planting: Planting) -> None:
    """Timestamp smoothed poses with the time of their computation."""

    def smoothed(original: Any) -> Any:
        def defective(poses: Any, stamp_ns: Any, *arguments: Any, **options: Any) -> Any:
            batch = original(poses, stamp_ns, *arguments, **options)
            return replace(batch, stamp_ns=batch.stamp_ns + poses._limits.lag_ns)

        return defective

    planting.replace_attribute(pose_output.ContinuousPoseOutput, "smoothed", smoothed)


# --- Files, queues, radios ------------------------------------------------------------------------------------


def reorder_lines(planting: Planting) -> None:
    """Swap every fiftieth recorded line with the next one."""
    held: dict[Any, bytes] = {}
    count: Counter[Any] = Counter()

    def put(original: Any) -> Any:
        def defective(disk: Any, line: bytes, *, measurement: bool = False) -> None:
            count[disk] += 1
            if disk not in held and count[disk] % 50 == 49:
                held[disk] = line
                return
            original(disk, line, measurement=measurement)
            if disk in held:
                original(disk, held.pop(disk))

        return defective

    planting.replace_attribute(RecordingThread, "put", put)


def journal_after_delivery(planting: Planting) -> None:
    """Deliver at once and write the journal half a second later."""

    def measured(client: Any, reading: Any) -> None:
        measurement = client._session.measurement(reading, client._timeline.unix_ns(reading.at_ns))
        client._link.offer(measurement)
        asyncio.get_running_loop().call_later(0.5, client._journal.write, measurement)

    planting.replace_attribute(daemon._StationClient, "_on_reading", lambda _: measured)


def keep_torn_line(planting: Planting) -> None:
    """Append to a torn line instead of cutting it."""
    planting.replace_attribute(RecordingWriter, "_cut_torn_line", lambda _: lambda _writer: None)


def unbound_reader_queue(planting: Planting) -> None:
    """Never disconnect a slow stream subscriber."""
    planting.replace_attribute(stream_server._Reader, "full", lambda _: property(lambda _reader: False))


def never_reopen_radio(planting: Planting) -> None:
    """Do not reopen a station's radio after its first fault."""

    async def supervise_radio(open_radio: Any, use: Any, _clock: Any) -> None:
        with contextlib.suppress(RadioError, StreamError):
            async with open_radio() as radio:
                await use(radio)
        await asyncio.Event().wait()

    planting.replace_attribute(daemon, "supervise_radio", lambda _: supervise_radio)
