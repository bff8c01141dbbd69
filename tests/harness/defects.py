"""Defects for the program: wrong functions in the place of right ones, for as long as a test or benchmark wants them.

`benchmarks/planted_defects.py` shows which checkers and tests see them.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
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
    """Puts wrong things in the place of right ones, and the right ones back.

    Attributes
    ----------
    planted
        Where, and what was there before: owner, name, right one.
    """

    def __init__(self) -> None:
        self.planted: list[tuple[Any, str, Any]] = []

    def put(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace an attribute by what is made of it."""
        right = owner.__dict__[name]
        self.planted.append((owner, name, right))
        setattr(owner, name, make(right))

    def undo(self) -> None:
        """Put everything back."""
        while self.planted:
            setattr(*self.planted.pop())


# --- Acknowledgements -----------------------------------------------------------------------------------------


def no_acknowledgement(planting: Planting) -> None:
    """Never tell a station what is in the recording."""
    planting.put(ReceiveWindow, "ack_bitmap", lambda _: lambda _peer, _counter: 0)
    planting.put(ReceiveWindow, "cumulative", lambda _: property(lambda _inbox: -1))


def acknowledged_before_written(planting: Planting) -> None:
    """Take everything for written that has come."""

    def settle(link: Any) -> None:
        while link._unwritten:
            reply = link._unwritten.popleft()
            link._master.station(reply.station).window.mark_written(reply.sequences)

    planting.put(link.SuperframeLink, "_settle", lambda _: settle)


def acknowledged_to_the_highest(planting: Planting) -> None:
    """Acknowledge what is missing below the highest number."""
    planting.put(SequenceSet, "cumulative", lambda _: property(lambda numbers: numbers.highest))


def deleted_when_sent(planting: Planting) -> None:
    """Delete what is on the air, whether it arrives or not."""

    def sent(right: Any) -> Any:
        def wrong(delivery: Any, sequences: Any) -> None:
            right(delivery, sequences)
            delivery._queue.remove(sequences)

        return wrong

    planting.put(DeliveryProgress, "mark_sent", sent)


def repeats_kept(planting: Planting) -> None:
    """Hand on whatever comes."""

    def take(right: Any) -> Any:
        return lambda window, number: right(window, number) or True

    planting.put(ReceiveWindow, "accept", take)


def repeats_kept_classic(planting: Planting) -> None:
    """Know nothing of what has come before."""

    def init(right: Any) -> Any:
        def wrong(station: Any, *arguments: Any) -> None:
            right(station, *arguments)
            station._known = deque(maxlen=0)

        return wrong

    planting.put(ingest._Station, "__init__", init)


# --- Numbers and codes ----------------------------------------------------------------------------------------


def numbers_again(planting: Planting) -> None:
    """Begin with number 0 after each start."""

    def read(right: Any) -> Any:
        return lambda *arguments: replace(right(*arguments), first_sequence=0, queued=())

    planting.put(daemon, "read_backlog", read)


def nonce_again(planting: Planting) -> None:
    """Introduce a station to each session with the same nonce."""

    def init(right: Any) -> Any:
        def wrong(client: Any, *arguments: Any, **named: Any) -> None:
            right(client, *arguments, **named)
            client._random_bits = lambda _bits: 7

        return wrong

    planting.put(SuperframeStation, "__init__", init)


def code_not_compared(planting: Planting) -> None:
    """Take each code for the right one, at the master and at the stations."""
    anything = SimpleNamespace(compare_digest=lambda _one, _other: True)
    for module in (master, station):
        planting.put(module, "hmac", lambda _: anything)


def old_beacon_accepted(planting: Planting) -> None:
    """Find the frame number of a beacon that is not new."""

    def counter_of(session: Any, beacon: Any) -> Any:
        newest = session.beacon.counter
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

    planting.put(ingest._Station, "_measurement", measurement)


def frequency_reversed(planting: Planting) -> None:
    """Carry a clock's offset on with the frequency's wrong sign."""

    def at_ns(line: Any, station_ns: int) -> int:
        return int(line.base_ns + round(line.offset_ns - line.frequency * line._seconds(station_ns)))

    planting.put(RegressionLine, "at_ns", lambda _: at_ns)


def beacon_beside(planting: Planting) -> None:
    """Take the time at which a beacon left for that of the beacon after it."""

    def reception(right: Any) -> Any:
        def wrong(session: Any) -> Any:
            found = right(session)
            return found and replace(found, received_ns=session.beacon.received_ns)

        return wrong

    planting.put(StationSession, "reception", reception)


def slot_beside(planting: Planting) -> None:
    """Reply a slot too late."""

    def slot_of(right: Any) -> Any:
        def wrong(session: Any) -> Any:
            slot = right(session)
            if slot is None:
                return None
            late_ns = slot.slot.end_ns - slot.slot.start_ns + session.timing.guard_ns
            moved = slot.slot._replace(
                start_ns=slot.slot.start_ns + late_ns, end_ns=slot.slot.end_ns + late_ns
            )
            return slot._replace(slot=moved, start_ns=slot.start_ns + late_ns)

        return wrong

    planting.put(StationSession, "_reply_slot", slot_of)


def whole_milliseconds(planting: Planting) -> None:
    """Round the time of a measurement down to whole milliseconds."""
    units = 1000 // TIME_UNIT_US

    def timed(right: Any) -> Any:
        def wrong(*arguments: Any) -> Any:
            found = right(*arguments)
            return found and found._replace(time=found.time // units * units)

        return wrong

    planting.put(StationSession, "timestamped", timed)


def latency_left_in(planting: Planting) -> None:
    """Leave the instrument's latency in the stamps."""

    def stamp(right: Any) -> Any:
        def wrong(times: Any, measured: Any) -> Any:
            found = right(times, measured)
            return found and found._replace(at_ns=found.at_ns + times.latency_ns)

        return wrong

    planting.put(DistanceTimestamper, "timestamp", stamp)


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

    planting.put(mission, "run_master", run_master)


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

    planting.put(pose_output, "ros_covariance", ros_covariance)


def smoothed_now(planting: Planting) -> None:
    """Stamp smoothed poses with the time at which they are made."""

    def smoothed(right: Any) -> Any:
        def wrong(poses: Any, stamp_ns: Any, *arguments: Any, **options: Any) -> Any:
            batch = right(poses, stamp_ns, *arguments, **options)
            return replace(batch, stamp_ns=batch.stamp_ns + poses._limits.lag_ns)

        return wrong

    planting.put(pose_output.ContinuousPoseOutput, "smoothed", smoothed)


# --- Files, queues, radios ------------------------------------------------------------------------------------


def another_order(planting: Planting) -> None:
    """Let each fiftieth line change places with the next one on its way to the disk."""
    held: dict[Any, bytes] = {}

    def put(right: Any) -> Any:
        def wrong(disk: Any, line: bytes) -> None:
            if disk not in held and disk.line_count % 50 == 49:
                held[disk] = line
                return
            right(disk, line)
            if disk in held:
                right(disk, held.pop(disk))

        return wrong

    planting.put(RecordingThread, "put", put)


def journalled_afterwards(planting: Planting) -> None:
    """Deliver at once, and write half a second later."""

    def measured(client: Any, reading: Any) -> None:
        measurement = client._session.measurement(reading, client._timeline.unix_ns(reading.at_ns))
        client._link.offer(measurement)
        asyncio.get_running_loop().call_later(0.5, client._journal.write, measurement)

    planting.put(daemon._StationClient, "_on_reading", lambda _: measured)


def torn_line_kept(planting: Planting) -> None:
    """Go on behind half a line."""
    planting.put(RecordingWriter, "_cut_torn_line", lambda _: lambda _writer: None)


def endless_queue(planting: Planting) -> None:
    """Let lines wait for a slow reader without a bound."""
    planting.put(stream_server._Reader, "full", lambda _: property(lambda _reader: False))


def radio_given_up(planting: Planting) -> None:
    """Use a station's radio until its first fault, and never again."""

    async def supervise_radio(open_radio: Any, use: Any, _clock: Any) -> None:
        with contextlib.suppress(RadioError, StreamError):
            async with open_radio() as radio:
                await use(radio)
        await asyncio.Event().wait()

    planting.put(daemon, "supervise_radio", lambda _: supervise_radio)
