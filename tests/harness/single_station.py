"""The master's side of the paper's protocol with one station, without chips: a test says what is lost and restarted."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from harness.radios import MS, PAPER

from tsgt.clock import UnixTimeline
from tsgt.config import ClassicMasterConfig, StationConfig
from tsgt.master.classic import ClassicLink
from tsgt.master.link_events import ClockUpdate, MeasurementReceived
from tsgt.radio import TX_DONE_NS, Packet, TrackCommand, Transmission
from tsgt.radio.classic import ClassicStation, LinkTiming, MeasurementMessage
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from tsgt.master.link_events import LinkEvent
    from tsgt.radio import LoRaSettings
    from tsgt.recording import ClockRecord

SECOND = 1000 * MS
START = 1_600_000_000 * SECOND
TURNAROUND_NS = 3 * MS
AGE_NS = 50 * MS
"""The instrument's newest measurement is so old when the master asks for it."""


class SingleStation:
    """The radio of a master, and at its other end station 1, which measures all the time.

    Attributes
    ----------
    station
        Its program; None while it is not running.
    ahead_ns
        By how much its clock is ahead of the master's.
    asked
        What the master has sent, and when that ended, on the master's clock in ns since the start.
    before
        Called with each request before it is sent: what happens meanwhile; returns for how many ns the master is busy.
    lost
        Called with each request that the station answers: whether its answer is lost.
    stamp_errors_ns
        Of each measurement that has come out, how far its stamp is off, and its bound.
    clocks
        What the synchronisations have found.
    """

    def __init__(self) -> None:
        self.clock = VirtualClock(START)
        self.station: ClassicStation | None = ClassicStation(1)
        self.ahead_ns = 7200 * SECOND
        self.asked: list[tuple[bytes, int]] = []
        self.before: Callable[[bytes], int] = lambda _: 0
        self.lost: Callable[[bytes], bool] = lambda _: False
        self.stamp_errors_ns: list[tuple[int, int]] = []
        self.clocks: list[ClockRecord] = []
        self._timing = LinkTiming(PAPER, 250 * MS)
        self._made_ns: dict[int, int] = {}
        self._arriving: asyncio.Queue[Packet] = asyncio.Queue()

    def restart(self, step_ns: int) -> None:
        """Start its program anew, with a clock that is ahead by so much more."""
        self.station = ClassicStation(1)
        self.ahead_ns += step_ns

    def count(self, payload: bytes) -> int:
        """Return how often the master has sent this."""
        return sum(asked == payload for asked, _ in self.asked)

    async def configure(self, settings: LoRaSettings) -> None:
        """Do nothing."""

    async def close(self) -> None:
        """Do nothing."""

    async def receive(self) -> Packet:
        """Return the station's next answer."""
        return await self._arriving.get()

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Send a request; what the station answers arrives when it would."""
        del at_ns  # the paper's protocol sends at once
        await asyncio.sleep(self.before(payload) / 1e9)
        started_ns = self.clock.monotonic_ns()
        end_ns = started_ns + self._timing.airtime_ns(len(payload))
        heard_ns = end_ns + self._timing.rx_done_ns
        await self.clock.sleep_until(end_ns + TX_DONE_NS)
        self.asked.append((payload, end_ns))
        answer = self._answer(payload, heard_ns)
        if answer is not None and not self.lost(payload):
            arrives_ns = (
                heard_ns + TURNAROUND_NS + self._timing.airtime_ns(len(answer)) + self._timing.rx_done_ns
            )
            packet = Packet(
                payload=answer,
                rssi_dbm=-80.0,
                snr_db=9.0,
                received_at_ns=arrives_ns,
                stamp_sigma_ns=1,
            )
            delay_s = (arrives_ns - self.clock.monotonic_ns()) / 1e9
            asyncio.get_running_loop().call_later(delay_s, self._arriving.put_nowait, packet)
        return Transmission(started_at_ns=started_ns, done_at_ns=end_ns + TX_DONE_NS, stamp_sigma_ns=1)

    def _answer(self, payload: bytes, heard_ns: int) -> bytes | None:
        if self.station is None:
            return None
        made_ns = START + heard_ns - AGE_NS
        self._made_ns[made_ns + self.ahead_ns] = made_ns
        self.station.measured(
            MeasurementMessage(
                station=1,
                status=0,
                zenith_angle_rad=1.5,
                horizontal_angle_rad=0.5,
                slope_distance_m=30.0,
                time_ns=made_ns + self.ahead_ns,
            )
        )
        answer = self.station.received(payload, START + heard_ns + self.ahead_ns)
        if isinstance(answer, TrackCommand):
            return self.station.executed(answer, ok=True)
        return answer if isinstance(answer, bytes) else None

    def report(self, event: LinkEvent) -> None:
        """Take what the link reports."""
        if isinstance(event, ClockUpdate):
            self.clocks.append(event.record)
        elif isinstance(event, MeasurementReceived):
            measurement = event.measurement
            assert measurement.host_time_ns is not None
            assert measurement.stamp_bound_ns is not None
            error_ns = measurement.stamp_ns - self._made_ns[measurement.host_time_ns]
            self.stamp_errors_ns.append((error_ns, measurement.stamp_bound_ns))


@asynccontextmanager
async def single_station() -> AsyncGenerator[SingleStation]:
    """Run a master's link with its one station."""
    field = SingleStation()
    stations = [StationConfig(station=1, prism=1, prism_constant_mm=0.0)]
    link = ClassicLink(
        stations, ClassicMasterConfig(kind="classic"), PAPER, field.clock, UnixTimeline(START), field.report
    )
    async with asyncio.TaskGroup() as group:
        running = group.create_task(link.run(field))
        yield field
        running.cancel()
