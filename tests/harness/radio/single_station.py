"""The polling protocol's link of a master with one station, without radios; the test scripts losses and restarts."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from harness.hardware.radios import MS, PAPER

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
"""Age of the newest measurement when the master polls it."""


class SingleStation:
    """Radio of a master whose other end is station 1, which measures continuously.

    Attributes
    ----------
    station
        None while its program is not running.
    offset_ns
        Clock offset; positive: station ahead of master.
    requests
        Payloads that the master has sent, with the end of each on its clock in ns since the start.
    before_request
        Called with each request before it is sent; returns for how many ns the master is busy.
    is_lost
        Called with each request that the station responds to: whether the response is lost.
    timestamp_errors_ns
        Timestamp error and bound of each published measurement.
    clocks
        Results of the clock synchronisation.
    """

    def __init__(self) -> None:
        self.clock = VirtualClock(START)
        self.station: ClassicStation | None = ClassicStation(1)
        self.offset_ns = 7200 * SECOND
        self.requests: list[tuple[bytes, int]] = []
        self.before_request: Callable[[bytes], int] = lambda _: 0
        self.is_lost: Callable[[bytes], bool] = lambda _: False
        self.timestamp_errors_ns: list[tuple[int, int]] = []
        self.clocks: list[ClockRecord] = []
        self._timing = LinkTiming(PAPER, 250 * MS)
        self._made_ns: dict[int, int] = {}
        self._arriving: asyncio.Queue[Packet] = asyncio.Queue()

    def restart(self, step_ns: int) -> None:
        """Restart the station with a clock that has stepped."""
        self.station = ClassicStation(1)
        self.offset_ns += step_ns

    def count(self, payload: bytes) -> int:
        """Return how often the master has sent this payload."""
        return sum(asked == payload for asked, _ in self.requests)

    async def configure(self, settings: LoRaSettings) -> None:
        """Do nothing."""

    async def close(self) -> None:
        """Do nothing."""

    async def receive(self) -> Packet:
        """Return the next response of the station."""
        return await self._arriving.get()

    async def transmit(self, payload: bytes, *, at_ns: int | None = None) -> Transmission:
        """Send a request; the response arrives with its delay."""
        del at_ns  # the paper's protocol sends at once
        await asyncio.sleep(self.before_request(payload) / 1e9)
        started_ns = self.clock.monotonic_ns()
        end_ns = started_ns + self._timing.airtime_ns(len(payload))
        received_ns = end_ns + self._timing.rx_done_ns
        await self.clock.sleep_until(end_ns + TX_DONE_NS)
        self.requests.append((payload, end_ns))
        response = self._response(payload, received_ns)
        if response is not None and not self.is_lost(payload):
            arrives_ns = (
                received_ns + TURNAROUND_NS + self._timing.airtime_ns(len(response)) + self._timing.rx_done_ns
            )
            packet = Packet(
                payload=response,
                rssi_dbm=-80.0,
                snr_db=9.0,
                received_at_ns=arrives_ns,
                stamp_sigma_ns=1,
            )
            delay_s = (arrives_ns - self.clock.monotonic_ns()) / 1e9
            asyncio.get_running_loop().call_later(delay_s, self._arriving.put_nowait, packet)
        return Transmission(started_at_ns=started_ns, done_at_ns=end_ns + TX_DONE_NS, stamp_sigma_ns=1)

    def _response(self, payload: bytes, received_ns: int) -> bytes | None:
        if self.station is None:
            return None
        made_ns = START + received_ns - AGE_NS
        self._made_ns[made_ns + self.offset_ns] = made_ns
        self.station.measured(
            MeasurementMessage(
                station=1,
                status=0,
                zenith_angle_rad=1.5,
                horizontal_angle_rad=0.5,
                slope_distance_m=30.0,
                time_ns=made_ns + self.offset_ns,
            )
        )
        response = self.station.received(payload, START + received_ns + self.offset_ns)
        if isinstance(response, TrackCommand):
            return self.station.executed(response, ok=True)
        return response if isinstance(response, bytes) else None

    def report(self, event: LinkEvent) -> None:
        """Take what the link reports."""
        if isinstance(event, ClockUpdate):
            self.clocks.append(event.record)
        elif isinstance(event, MeasurementReceived):
            measurement = event.measurement
            assert measurement.host_time_ns is not None
            assert measurement.stamp_bound_ns is not None
            error_ns = measurement.stamp_ns - self._made_ns[measurement.host_time_ns]
            self.timestamp_errors_ns.append((error_ns, measurement.stamp_bound_ns))


@asynccontextmanager
async def single_station() -> AsyncGenerator[SingleStation]:
    """Run the link of a master with one station."""
    field = SingleStation()
    stations = [StationConfig(station=1, prism=1, prism_constant_mm=0.0)]
    link = ClassicLink(
        stations, ClassicMasterConfig(kind="classic"), PAPER, field.clock, UnixTimeline(START), field.report
    )
    async with asyncio.TaskGroup() as group:
        running = group.create_task(link.run(field))
        yield field
        running.cancel()
