"""Demand and grants: what each station will send next, and how long a reply it may send. Sans-I/O.

A slot longer than its reply costs every station time; one that is too short delays a measurement by a frame. The master
predicts each reply from the period of the instrument, its newest measurement and the outstanding ones.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from tsgt.model import Status
from tsgt.radio.commands import MeasureCommand
from tsgt.radio.superframe.slots import COMPOSE_LEAD_NS, MAX_FRAME_NS
from tsgt.radio.superframe.wire import (
    ACK_FRAMES,
    GRANT_BYTES,
    SINGLE_QUALITY,
    CommandResponse,
    EncodedMeasurement,
    MeasurementBlock,
    Reply,
    SingleMeasurement,
    StatusReport,
    reply_bytes,
)
from tsgt.timesync import Period, Periodicity

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.receive_window import ReceiveWindow
    from tsgt.radio.superframe.reception import ReplyTiming
    from tsgt.radio.superframe.slots import FrameTiming
    from tsgt.radio.superframe.timing import StationTiming

DEFAULT_GRANT = GRANT_BYTES.index(44)
"""Of an unknown station: join request, status report and a measurement, or five measurements."""

MAX_GRANT = GRANT_BYTES.index(125)
MAX_GRANT_FEW_STATIONS = GRANT_BYTES.index(71)
"""Below :data:`MANY_STATIONS`, where the backlog of one station would delay the others."""

MANY_STATIONS = 8

ABSENT_FRAMES = 6  # a station silent for this many frames gets at most :data:`DEFAULT_GRANT`

MAX_RETRY_SILENT_FRAMES = 4  # a station silent for longer gets no slot in a retry frame

MAX_MEASUREMENTS = 15

_NOISE = (31, -17, 54, -40, 8, -62, 25)
"""1 mm across the line of sight, in units of an angle at 75 m; twice the noise of a distance."""

_GAP = 3  # assumed gap of the sequence numbers after a loss

EARLY_US = 5_000  # how early a measurement may be,
EARLY_SPREADS = 3  # plus this multiple of the jitter of its period


INITIAL_EXCHANGES = 8
EXCHANGE_INTERVAL = 32
"""A two-way exchange measures the link delay: this many at the start, then one in this many frames."""

EXCHANGE_STEP = 5  # frames between the exchanges of neighbouring stations, which spreads the long replies

RETRY_INTERVAL = 32
"""Frames between requests for outstanding measurements that the station did not send though it had room."""

TYPICAL_PERIOD = Period(period_us=400_000, phase_us=0, jitter_us=50_000)
"""Of a tracking instrument, until its own is estimated."""

MAX_BLOCK_BYTES = 21  # upper bound of a measurement in a block of its own

AGE_WINDOW = 32  # number of replies whose newest measurement's age counts


@dataclass(frozen=True, slots=True)
class Demand:
    """Predicted content of a reply."""

    measurements: int  # their number
    scattered: bool = False  # their sequence numbers have gaps
    plain: bool = True  # they fit a reply of the form single: the station's clock has converged
    extended: bool = False  # with status report and turnaround
    response: bool = False
    single_measurement: bool = False


def grant(demand: Demand, *, cap: int, silent_frames: int) -> int:
    """Return the grant, an index into :data:`GRANT_BYTES`, at most ``cap``."""
    needed_bytes = demand_bytes(demand)
    if silent_frames >= ABSENT_FRAMES:
        cap = min(cap, DEFAULT_GRANT)
    fitting = (index for index, granted_bytes in enumerate(GRANT_BYTES) if granted_bytes >= needed_bytes)
    return min(next(fitting, cap), cap)


def max_grant(timing: FrameTiming, stations: int) -> int:
    """Return the largest grant with which the slots of this many stations fit into a frame."""
    slot_ns = MAX_FRAME_NS // stations - timing.guard_ns
    most = MAX_GRANT if stations >= MANY_STATIONS else MAX_GRANT_FEW_STATIONS
    fitting = [index for index in range(most + 1) if timing.airtime_ns(GRANT_BYTES[index]) <= slot_ns]
    return max(fitting[-1] if fitting else 0, DEFAULT_GRANT)


def retry_stations(silent_frames: Mapping[int, int], granted: Sequence[int]) -> set[int]:
    """Return the stations that get a retry frame of their own; empty: the next frame is for all.

    With many stations a lost reply waits long for the next slot. After a frame for all, a short frame repeats the slots
    of the stations that are usually received and were not. A single loss of a single station is not worth a frame.
    Both arguments are by station index; ``granted`` is that of the previous frame, empty without one.
    """
    present = {index for index, frames in silent_frames.items() if frames <= MAX_RETRY_SILENT_FRAMES}
    if len(present) < MANY_STATIONS or not granted or not all(granted[index] for index in present):
        return set()
    missed = {index for index in present if silent_frames[index]}
    worthwhile = sum(silent_frames[index] for index in missed) > 1
    return missed if worthwhile and 2 * len(missed) <= len(present) else set()


def expected_measurements(
    period: Period, *, newest_us: int, replied_us: int, slot_us: int, ready_us: int = 0
) -> int:
    """Return how many measurements a station can send in its slot that it could not send before, at least one.

    ``newest_us`` is the time of its newest received measurement, ``replied_us`` the start of its last received reply,
    ``slot_us`` the start of its slot, and ``ready_us`` the delay from a measurement until a reply can carry it.
    """
    if (
        newest_us <= replied_us - 1.5 * period.period_us
    ):  # measurements had stopped and may have resumed since
        return max(math.ceil((slot_us - replied_us) / period.period_us), 1)
    made_us = slot_us - max(COMPOSE_LEAD_NS // 1000, ready_us) + EARLY_US + EARLY_SPREADS * period.jitter_us
    return max(int((made_us - newest_us) / period.period_us), 1)


@lru_cache
def demand_bytes(demand: Demand) -> int:
    """Return the length of a reply with this content, authentication code included, of an instrument in motion."""
    count = min(demand.measurements, MAX_MEASUREMENTS)
    numbers = [count + _GAP * demand.scattered, *range(count - 1, 0, -1)] if count else []
    block = MeasurementBlock(measurements=tuple(_typical_measurement(number) for number in numbers))
    if not demand.plain:
        block = replace(block, quality=SINGLE_QUALITY + 1, prism=1)
    status_report = StatusReport(
        prism=1, direct=False, connected=True, missed_slots=0, rejected_beacons=0, rssi_dbm=-100
    )
    return reply_bytes(
        Reply(
            blocks=(block,) if numbers else (),
            status_report=status_report if demand.extended else None,
            turnaround_us=0 if demand.extended else None,
            response=CommandResponse(0, ok=True) if demand.response else None,
            single_measurement=(
                SingleMeasurement(0, Status.OK, 0, 0, 1) if demand.single_measurement else None
            ),
        )
    )


def _typical_measurement(number: int) -> EncodedMeasurement:
    """Return a noisy measurement of a turning robot at 1.5 m/s, 75 m away, every 0.4 s."""
    noise = _NOISE[number % len(_NOISE)]
    return EncodedMeasurement(
        sequence=number,
        time=25_000 * number,
        status=Status.OK,
        horizontal=21_000 * number + 40 * number * number + noise,
        zenith=4_000_000 + noise,
        distance=750_000 + 4_000 * number + 30 * number * number - noise,
    )


class DemandEstimator:
    """Predicts the replies of one station; ``initial_interval`` is the frames between its initial two-way exchanges."""

    def __init__(self, number: int, initial_interval: int) -> None:
        self._number = number
        self._initial_interval = initial_interval
        self._periodicity = Periodicity()
        self._replied_us: int | None = None
        self._newest_ages_us: deque[int] = deque(maxlen=AGE_WINDOW)
        self._withheld = 0
        self._repeats_backlog = False
        self._plain = False

    def join(self, *, repeats_backlog: bool) -> None:
        """Take a join request; a restarted station may repeat its whole backlog."""
        self._repeats_backlog = repeats_backlog

    def update(
        self,
        reply: Reply,
        at: ReplyTiming,
        measured_ns: Sequence[int],
        timing: StationTiming,
        outstanding_before: int,
        outstanding: int,
    ) -> None:
        """Take a reply, with the times of its new measurements, and the outstanding ones before and after it."""
        for instant_ns in measured_ns:
            self._periodicity.add(timing.session_us(instant_ns))
        self._replied_us = timing.session_us(at.slot_ns)
        if measured_ns:
            self._newest_ages_us.append((at.slot_ns - max(measured_ns)) // 1000)
        # Without blocks the grant may have been too small: blocks that are not plain take more.
        self._plain = bool(reply.blocks) and _is_plain(reply.blocks[0])
        has_room = at.granted_bytes - at.payload_bytes >= MAX_BLOCK_BYTES
        self._repeats_backlog = self._repeats_backlog and not has_room
        if outstanding < outstanding_before:
            self._withheld = 0  # it sends the outstanding ones; the next may not have fitted
        elif has_room:
            self._withheld = outstanding  # it had room for any of them
        self._withheld = min(self._withheld, outstanding)

    def predict(
        self,
        counter: int,
        slot_us: int,
        window: ReceiveWindow,
        *,
        silent_frames: int,
        exchanges: int,
        pending: Command | None,
    ) -> Demand | None:
        """Predict the reply in a slot at ``slot_us`` session time, after ``exchanges``; None before a measurement."""
        newest_us = self._periodicity.newest_us
        if newest_us is None or self._replied_us is None:
            return None
        new = expected_measurements(
            self._periodicity.period or TYPICAL_PERIOD,
            newest_us=newest_us,
            replied_us=self._replied_us,
            slot_us=slot_us,
            ready_us=self.ready_us,
        )
        withheld = 0 if counter % RETRY_INTERVAL == self._number else self._withheld
        outstanding = max(window.outstanding - withheld, 0)
        if exchanges < INITIAL_EXCHANGES:
            exchange = (counter - self._number) % self._initial_interval == 0
        else:
            exchange = (counter - EXCHANGE_STEP * self._number) % EXCHANGE_INTERVAL == 0
        # The acknowledgement of a reply before the bitmap may have been lost, and the reply is repeated.
        unacknowledged = window.last_reply_measurements if silent_frames >= ACK_FRAMES else 0
        repeated = MAX_MEASUREMENTS if self._repeats_backlog else 0
        return Demand(
            measurements=new + outstanding + window.unwritten + unacknowledged + repeated,
            scattered=outstanding > 0,
            plain=self._plain,
            extended=exchange,
            response=pending is not None,
            single_measurement=isinstance(pending, MeasureCommand),
        )

    @property
    def ready_us(self) -> int:
        """Delay from a measurement until a reply can carry it: the minimum of recent replies.

        Room for a measurement that cannot be read in time would lengthen every frame, and leave frames as long as the
        period no time to move their phase.
        """
        return min(self._newest_ages_us, default=0)


def _is_plain(block: MeasurementBlock) -> bool:
    return (
        block.quality <= SINGLE_QUALITY
        and block.prism is None
        and not (block.beacon_relative or block.wide or block.far)
    )
