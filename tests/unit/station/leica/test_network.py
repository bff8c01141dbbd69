"""The Leica driver over a network: what it says when something else is there, and times that it cannot bound."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.instruments.leica import LeicaBench, leica_bench, leica_config
from harness.instruments.network_line import PeerKind, SimulatedNetwork
from structlog.testing import capture_logs

from tsgt.config import TcpAddress
from tsgt.errors import InstrumentError
from tsgt.model import Status
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.station.geocom import ReturnCode, Rpc
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from tsgt.simulation.kernel.event_loop import VirtualEventLoop


def over_network(bench: LeicaBench) -> tuple[LeicaInstrument, SimulatedNetwork]:
    """Return a driver that is connected to the instrument of a bench over a network."""
    timeline = cast("VirtualEventLoop", asyncio.get_running_loop())._timeline
    network = SimulatedNetwork(bench.station, timeline, bench.clock, np.random.default_rng(3))
    config = leica_config().model_copy(update={"port": TcpAddress("simulated", 1212)})
    return LeicaInstrument(config, network.open, bench.clock), network


@pytest.mark.parametrize(
    ("peer", "complaint"),
    [
        (PeerKind.SILENT, "no instrument responds; check that it is on"),
        (PeerKind.FOREIGN, "something else than an instrument answers there"),
        (PeerKind.REFUSED, "nothing listens there"),
    ],
)
async def test_other_peer_is_named(peer: PeerKind, complaint: str) -> None:
    """In one line, within the time of some requests."""
    async with leica_bench() as bench:
        instrument, network = over_network(bench)
        network.faults.peer = peer
        async with asyncio.timeout(12.0):
            with pytest.raises(InstrumentError, match=complaint):
                await instrument.connect()


async def test_search_of_an_earlier_client_is_aborted() -> None:
    """It would keep the instrument from responding for a minute."""
    async with leica_bench() as bench:
        instrument, network = over_network(bench)
        port = await network.open(0)
        port.write(b"%R1Q,9051,1:1,1\r\n")
        await asyncio.sleep(1.0)
        await port.close()
        async with asyncio.timeout(15.0):
            assert "230001" in await instrument.connect()


async def test_times_state_the_unknown_delay() -> None:
    """A sigma of the fastest round trip over the root of twelve, and no error above twice that."""
    async with leica_bench() as bench:
        instrument, network = over_network(bench)
        network.faults.jitter_ms = 3.0
        await instrument.connect()
        await instrument.track(1)
        readings = [await instrument.read() for _ in range(20)]
        truth = {each.instrument_ms: each.true_ns for each in bench.station.reported_distances}
        for reading in readings:
            assert reading.instrument_time_ns is not None
            late_ns = reading.at_ns - truth[reading.instrument_time_ns // 1_000_000]
            assert 24e6 / 12**0.5 <= reading.sigma_ns <= 10e6
            assert abs(late_ns) < 2 * reading.sigma_ns


async def test_unbounded_times_are_not_used() -> None:
    """Every packet half a second late or more: no distance is used, and the reason is stated until it is over."""
    async with leica_bench() as bench:
        instrument, network = over_network(bench)
        network.faults.burst_share = 1.0
        with capture_logs() as logs:
            await instrument.connect()
            await instrument.track(1)
            async with asyncio.timeout(40.0):
                reading = await instrument.read()
                assert reading.status is Status.ERROR
                assert reading.slope_distance_m is None
                assert "their times are known to" in instrument.condition.problem
                network.faults.burst_share = 0.0
                while not (await instrument.read()).status.usable:
                    pass
        assert not instrument.condition.problem
        assert [entry["event"] for entry in logs if "certain" in entry["event"]] == [
            "distance_time_uncertain",
            "distance_time_certain",
        ]
        await instrument.close()


@pytest.mark.parametrize("code", [ReturnCode.NOT_IMPL, ReturnCode.TMC_ANGLE_ERROR])
async def test_distances_without_a_clock_are_an_error(code: ReturnCode) -> None:
    """The instrument does not say what time it is, so that no distance has a time: not a client that says nothing."""
    async with leica_bench() as bench:
        instrument, _ = over_network(bench)
        refused = ForcedResponse(code=code, rpc=Rpc.TMC_GET_ANGLE1, times=10_000)
        bench.station.server.forced.append(refused)
        await instrument.connect()
        await instrument.track(1)
        async with asyncio.timeout(10.0):
            reading = await instrument.read()
        assert (reading.status, reading.slope_distance_m) == (Status.ERROR, None)
        assert f"does not report the time of its clock: {code:d}" in instrument.condition.problem
        bench.station.server.forced.clear()
        async with asyncio.timeout(20.0):
            while not (await instrument.read()).status.usable:
                pass
        assert not instrument.condition.problem
        await instrument.close()
