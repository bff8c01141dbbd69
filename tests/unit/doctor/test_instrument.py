"""Checks of ``tsgt doctor``: the instrument, directly or through the client."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.fake_machine import NOW_NS, FakeMachine
from harness.hardware.radios import running_timeline

from tsgt.config import LeicaInstrumentConfig, ScenarioConfig
from tsgt.doctor import Outcome
from tsgt.doctor.instrument import check_identity
from tsgt.errors import InstrumentError, StreamError
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.world import scenario_world
from tsgt.station import ClientStatus
from tsgt.station.leica import Identity

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.station.serial import Port

NAMES = ("instrument", "licence", "battery", "level")


def connected(fake: FakeMachine) -> tuple[SimulatedTotalStation, SimulatedLine]:
    """Connect a simulated total station to a machine's line."""
    scenario = ScenarioConfig()
    timeline = running_timeline()
    rng = np.random.default_rng(1)
    instrument = SimulatedTotalStation(
        scenario.stations[0], scenario, scenario_world(scenario, 60.0, rng), timeline, rng
    )
    line = SimulatedLine(instrument, timeline, VirtualClock(NOW_NS), name="ttyUSB0")
    fake.port = line.open
    return instrument, line


def client_status(
    instrument: str | None = "Leica TS16 1234567", *, problem: str = "", battery: int | None = 72
) -> ClientStatus:
    """Make the status of a client."""
    return ClientStatus(
        stamp_ns=NOW_NS,
        station=1,
        instrument=instrument,
        activity="tracking",
        problem=problem,
        battery_percent=battery,
        settings=None,
        mode="tracking",
        prism=1,
        locked=True,
        last=None,
        measurements=1234,
        rate_hz=2.5,
        journal="/var/lib/tsgt/station1.jsonl",
        journal_ok=True,
        journal_waiting=0,
        journal_lost=0,
        master_heard_s=0.4,
        rssi_dbm=-80.0,
        snr_db=8.0,
        unknown_packets=0,
        radio_ok=True,
        protocol="superframe",
        authenticated=True,
        joined=True,
        queued=0,
        missed_slots=0,
        rejected_beacons=0,
        refused=0,
        clock_bound_ns=300_000,
    )


async def test_ready_instrument_passes(tmp_path: Path) -> None:
    """It is identified, licensed, charged and level, and the line is closed again."""
    fake = FakeMachine(tmp_path)
    _, line = connected(fake)
    findings = await fake.run_checks()
    assert {name: findings[name].outcome for name in NAMES} == dict.fromkeys(NAMES, Outcome.OK)
    assert "85 %" in findings["battery"].detail
    port = await line.open(115_200)  # raises while the port is open elsewhere
    await port.close()


async def test_missing_licence_fails(tmp_path: Path) -> None:
    """Without the licence it does not search or lock."""
    fake = FakeMachine(tmp_path)
    instrument, _ = connected(fake)
    instrument.robotic_licence = False
    found = (await fake.run_checks())["licence"]
    assert found.ok is False
    assert "GeoCOM Robotic" in found.detail


@pytest.mark.parametrize(
    ("percent", "external", "outcome"),
    [(45.0, False, Outcome.NOTE), (10.0, False, Outcome.FAILED), (10.0, True, Outcome.OK)],
)
async def test_low_battery_is_reported(
    tmp_path: Path,
    percent: float,
    external: bool,  # noqa: FBT001 (a case)
    outcome: Outcome,
) -> None:
    """Half is a note, a fifth is a failure, external power passes."""
    fake = FakeMachine(tmp_path)
    instrument, _ = connected(fake)
    instrument.battery_percent, instrument.external_power = percent, external
    assert (await fake.run_checks())["battery"].outcome is outcome


@pytest.mark.parametrize(("tilt_rad", "expected"), [(0.0009, "3.1'"), (0.01, "not level")])
async def test_instrument_that_is_not_level_is_a_note(tmp_path: Path, tilt_rad: float, expected: str) -> None:
    """On a desk no instrument is level."""
    fake = FakeMachine(tmp_path)
    instrument, _ = connected(fake)
    instrument.tilt_rad = (tilt_rad, 0.0)
    found = (await fake.run_checks())["level"]
    assert found.outcome is Outcome.NOTE
    assert expected in found.detail


async def test_other_baud_rate_is_a_note(tmp_path: Path) -> None:
    """The finding says what to set."""
    fake = FakeMachine(tmp_path)
    connected(fake)
    fake.change("client.toml", 'kind = "leica"', 'kind = "leica"\nbaud = 19_200')
    found = (await fake.run_checks())["instrument"]
    assert found.outcome is Outcome.NOTE
    assert "baud = 115200" in found.detail


async def test_instrument_that_is_off_fails(tmp_path: Path) -> None:
    """One failure; dependent checks are skipped."""
    fake = FakeMachine(tmp_path)
    _, line = connected(fake)
    line.faults.drop_requests = True  # its battery is removed
    findings = await fake.run_checks()
    assert findings["instrument"].ok is False
    assert "check that it is on" in findings["instrument"].detail
    assert {findings[name].ok for name in NAMES[1:]} == {None}


def test_instrument_without_target_recognition_fails(tmp_path: Path) -> None:
    """A manual instrument responds, but cannot track a prism."""
    config = LeicaInstrumentConfig(kind="leica", port=tmp_path, prism_type="round")
    found = check_identity(Identity(model="TC1202", atr=False), config, 115_200)
    assert found.ok is False
    assert "TC1202, number unknown" in found.detail


async def test_line_that_cannot_be_opened_fails(tmp_path: Path) -> None:
    """The finding has the error of the port."""
    fake = FakeMachine(tmp_path)

    async def refuse(_baud: int) -> Port:
        raise InstrumentError("ttyUSB0: is locked by somebody")

    fake.port = refuse
    assert "locked by somebody" in (await fake.run_checks())["instrument"].detail


async def test_running_client_reports_the_instrument(tmp_path: Path) -> None:
    """Instrument and radio stay open in the client."""
    fake = FakeMachine(tmp_path)
    fake.status = client_status()
    fake.holders = {"ttyUSB0": "tsgt-client (process 71)", "spidev0.0": "tsgt-client (process 71)"}
    fake.hal_error = AssertionError("must not be opened")
    findings = await fake.run_checks()
    assert [each for each in findings.values() if each.ok is False] == []
    assert "1234 measured" in findings["daemon"].detail
    assert "Leica TS16 1234567" in findings["instrument"].detail
    assert "72 %" in findings["battery"].detail
    assert (findings["licence"].ok, findings["level"].ok, findings["radio"].ok) == (None, None, None)
    assert "sudo systemctl stop tsgt-client" in findings["licence"].detail


@pytest.mark.parametrize("name", ["Leica TS16 1234567", None])
async def test_problem_of_the_client_fails(tmp_path: Path, name: str | None) -> None:
    """The problem is in the finding."""
    fake = FakeMachine(tmp_path)
    fake.status = client_status(name, problem="the licence GeoCOM Robotic is missing", battery=None)
    findings = await fake.run_checks()
    assert findings["instrument"].ok is False
    assert "GeoCOM Robotic is missing" in findings["instrument"].detail
    assert findings["battery"].ok is None


@pytest.mark.parametrize("name", ["client.toml", "master.toml"])
async def test_daemon_without_access_is_left_alone(tmp_path: Path, name: str) -> None:
    """Systemd reports that it is running."""
    fake = FakeMachine(tmp_path)
    assert fake.service is not None
    fake.service |= {"ActiveState": "active", "SubState": "running"}
    fake.hal_error = AssertionError("must not be opened")
    findings = await fake.run_checks(name)
    assert findings["daemon"].outcome is Outcome.NOTE
    assert "sudo tsgt doctor" in findings["daemon"].detail
    assert findings["radio"].ok is None
    assert [each for each in findings.values() if each.ok is False] == []


async def test_stuck_client_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It must be restarted."""

    def stuck(_path: Path) -> ClientStatus | None:
        raise StreamError("client.sock: no status within 5 s; the daemon is stuck, see its log")

    fake = FakeMachine(tmp_path)
    monkeypatch.setattr(fake, "ask_client", stuck)
    found = (await fake.run_checks())["daemon"]
    assert found.ok is False
    assert "sudo systemctl restart tsgt-client" in found.detail


async def test_bridge_needs_its_program(tmp_path: Path) -> None:
    """A missing or non-executable program fails."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'kind = "leica"', 'kind = "bridge"\ncommand = ["my-program"]')
    text = (tmp_path / "client.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith(("port =", "prism_type"))]
    fake.write("client.toml", "\n".join(lines))
    assert (await fake.run_checks())["instrument"].ok is False
    fake.programs = {"my-program"}
    assert (await fake.run_checks())["instrument"].ok is True
