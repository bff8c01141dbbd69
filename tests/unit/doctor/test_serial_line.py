"""Checks of ``tsgt doctor``: the serial line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.hardware.fake_machine import ADAPTER, FakeMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

SERVICE_USER = User(name="tsgt", uid=4711, groups=frozenset())


async def test_ready_line_passes(tmp_path: Path) -> None:
    """Stable name, permissions, no other user, short latency: four findings without advice."""
    findings = await FakeMachine(tmp_path).run_checks()
    for name in ("serial_port", "serial_port_free", "latency_timer"):
        assert findings[name].outcome is Outcome.OK, findings[name]


async def test_missing_line_names_existing_adapters(tmp_path: Path) -> None:
    """The finding names another adapter that is plugged in."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", ADAPTER, "usb-another-one")
    findings = await fake.run_checks()
    assert findings["serial_port"].ok is False
    assert ADAPTER in findings["serial_port"].detail
    for name in ("serial_port_free", "latency_timer", "instrument", "licence", "battery", "level"):
        assert findings[name].ok is None


async def test_missing_adapter_is_reported(tmp_path: Path) -> None:
    """Nothing under by-id: the cable is unplugged."""
    fake = FakeMachine(tmp_path)
    (tmp_path / "dev/serial/by-id" / ADAPTER).unlink()
    assert "no adapter" in (await fake.run_checks())["serial_port"].detail


async def test_dangling_link_fails(tmp_path: Path) -> None:
    """The device of the link is gone."""
    fake = FakeMachine(tmp_path)
    fake.tty.unlink()
    found = (await fake.run_checks())["serial_port"]
    assert found.ok is False
    assert "is a dangling link" in found.detail


async def test_unstable_name_is_a_note_with_the_stable_one(tmp_path: Path) -> None:
    """ttyUSB0 may be ttyUSB1 after the cable was unplugged."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", f"dev/serial/by-id/{ADAPTER}", "dev/ttyUSB0")
    found = (await fake.run_checks())["serial_port"]
    assert found.outcome is Outcome.NOTE
    assert f'port = "{tmp_path}/dev/serial/by-id/{ADAPTER}"' in found.detail


async def test_user_without_permission_is_told_the_group(tmp_path: Path) -> None:
    """The user of the service counts, not the user of the checks."""
    fake = FakeMachine(tmp_path)
    fake.daemon = SERVICE_USER
    found = (await fake.run_checks())["serial_port"]
    assert found.ok is False
    group = "dialout" if fake.tty.stat().st_gid else "rule"
    assert group in found.detail
    assert "tsgt" in found.detail


async def test_device_of_root_needs_a_rule(tmp_path: Path) -> None:
    """Joining a group does not help if the group has no permission."""
    fake = FakeMachine(tmp_path)
    fake.daemon = SERVICE_USER
    fake.tty.chmod(0o600)
    found = (await fake.run_checks())["serial_port"]
    assert found.ok is False
    assert "udev" in found.detail


async def test_busy_line_is_not_opened(tmp_path: Path) -> None:
    """Two programs corrupt each other's data."""
    fake = FakeMachine(tmp_path)
    fake.holders["ttyUSB0"] = "minicom (process 99)"
    findings = await fake.run_checks()
    assert findings["serial_port_free"].ok is False
    assert "minicom (process 99)" in findings["serial_port_free"].detail
    assert findings["instrument"].ok is None


async def test_modem_manager_is_a_note_without_udev_rules(tmp_path: Path) -> None:
    """It opens every line that is plugged in."""
    fake = FakeMachine(tmp_path)
    fake.commands["systemctl is-active ModemManager.service"] = "active\n"
    assert (await fake.run_checks())["serial_port_free"].outcome is Outcome.NOTE
    fake.write("etc/udev/rules.d/60-tsgt.rules", "")
    assert (await fake.run_checks())["serial_port_free"].outcome is Outcome.OK


@pytest.mark.parametrize(
    ("timer_ms", "outcome"), [(16, Outcome.FAILED), (2, Outcome.OK), (1, Outcome.OK), (None, Outcome.OK)]
)
async def test_long_latency_timer_fails(tmp_path: Path, timer_ms: int | None, outcome: Outcome) -> None:
    """FTDI adapters have 16 ms by default; others have no timer."""
    fake = FakeMachine(tmp_path)
    fake.latency_timer_ms = timer_ms
    found = (await fake.run_checks())["latency_timer"]
    assert found.outcome is outcome
    if outcome is Outcome.FAILED:
        assert "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in found.detail
