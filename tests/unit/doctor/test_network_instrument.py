"""Checks of ``tsgt doctor``: an instrument in the network."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.fake_machine import ADAPTER, FakeMachine
from harness.hardware.radios import running_timeline
from harness.instruments.network_line import PeerKind, SimulatedNetwork

from tsgt.config import ScenarioConfig
from tsgt.doctor import Outcome
from tsgt.simulation.instrument import SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def fake(tmp_path: Path) -> FakeMachine:
    """Return a machine whose client has an instrument in the network, and whose unit may use it."""
    machine = FakeMachine(tmp_path)
    text = (tmp_path / "client.toml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("port = "))
    machine.change("client.toml", line, 'port = "tcp://192.168.1.10:1212"')
    assert machine.service is not None
    machine.service |= {
        "PrivateNetwork": "no",
        "RestrictAddressFamilies": "AF_UNIX AF_INET AF_INET6",
        "IPAddressAllow": "0.0.0.0/0 ::/0",
    }
    return machine


def connect(fake: FakeMachine) -> SimulatedNetwork:
    """Connect a simulated total station to the machine's network."""
    scenario, timeline, rng = ScenarioConfig(), running_timeline(), np.random.default_rng(1)
    world = scenario_world(scenario, 60.0, rng)
    instrument = SimulatedTotalStation(scenario.stations[0], scenario, world, timeline, rng)
    network = SimulatedNetwork(instrument, timeline, VirtualClock(0), rng)
    fake.port = network.open
    return network


async def test_instrument_in_the_network_is_checked(fake: FakeMachine) -> None:
    """As one on a serial line, without checks of a device and of a baud rate."""
    connect(fake)
    found = await fake.run_checks()
    assert found["instrument_network"].outcome is Outcome.OK
    assert found["instrument"].outcome is Outcome.OK
    assert found["instrument"].detail.endswith("responds at tcp://192.168.1.10:1212")
    assert found["licence"].outcome is Outcome.OK
    assert not {"serial_port", "serial_port_free", "latency_timer"} & set(found)


async def test_sandbox_without_network_is_found(fake: FakeMachine) -> None:
    """The unit as shipped; the remedy is one line."""
    connect(fake)
    assert fake.service is not None
    fake.service["PrivateNetwork"] = "yes"
    found = (await fake.run_checks())["instrument_network"]
    assert found.outcome is Outcome.FAILED
    assert "PrivateNetwork=yes" in found.detail
    assert "network-instrument.conf" in found.detail


async def test_other_server_is_found(fake: FakeMachine) -> None:
    """Something else answers at the address."""
    connect(fake).faults.peer = PeerKind.FOREIGN
    found = (await fake.run_checks())["instrument"]
    assert found.outcome is Outcome.FAILED
    assert "something else than an instrument answers there" in found.detail
    assert ADAPTER not in found.detail
