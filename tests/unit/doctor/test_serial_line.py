"""The checks of ``tsgt doctor`` that look at the serial line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.made_up_machine import ADAPTER, MadeUpMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

STRANGER = User(name="tsgt", uid=4711, groups=frozenset())


async def test_line_that_is_there_is_well(tmp_path: Path) -> None:
    """A stable name, rights, nobody else, no delay: four lines without a word of advice."""
    findings = await MadeUpMachine(tmp_path).examine()
    for name in ("serial_port", "serial_port_free", "latency_timer"):
        assert findings[name].outcome is Outcome.OK, findings[name]


async def test_missing_line_names_those_that_are_there(tmp_path: Path) -> None:
    """Another adapter than the one in the configuration is found by its name in the line."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", ADAPTER, "usb-another-one")
    findings = await made_up.examine()
    assert findings["serial_port"].ok is False
    assert ADAPTER in findings["serial_port"].detail
    for name in ("serial_port_free", "latency_timer", "instrument", "licence", "battery", "level"):
        assert findings[name].ok is None


async def test_line_without_any_adapter_says_so(tmp_path: Path) -> None:
    """Nothing under by-id: the cable is out."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / "dev/serial/by-id" / ADAPTER).unlink()
    assert "no adapter at all" in (await made_up.examine())["serial_port"].detail


async def test_name_that_points_to_nothing_fails(tmp_path: Path) -> None:
    """A link whose device has gone is no line."""
    made_up = MadeUpMachine(tmp_path)
    made_up.tty.unlink()
    found = (await made_up.examine())["serial_port"]
    assert found.ok is False
    assert "points to nothing" in found.detail


async def test_name_that_changes_is_noted_with_the_one_that_stays(tmp_path: Path) -> None:
    """TtyUSB0 may be ttyUSB1 after the cable was out; the name to write is in the line."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", f"dev/serial/by-id/{ADAPTER}", "dev/ttyUSB0")
    found = (await made_up.examine())["serial_port"]
    assert found.outcome is Outcome.NOTE
    assert f'port = "{tmp_path}/dev/serial/by-id/{ADAPTER}"' in found.detail


async def test_user_without_rights_is_told_the_group(tmp_path: Path) -> None:
    """The rights are those of who runs the service, not of who runs the checks."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = STRANGER
    found = (await made_up.examine())["serial_port"]
    assert found.ok is False
    group = "dialout" if made_up.tty.stat().st_gid else "rule"
    assert group in found.detail
    assert "tsgt" in found.detail


async def test_device_that_is_left_to_root_needs_a_rule(tmp_path: Path) -> None:
    """Joining a group does not help where the group has no right."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = STRANGER
    made_up.tty.chmod(0o600)
    found = (await made_up.examine())["serial_port"]
    assert found.ok is False
    assert "udev" in found.detail


async def test_line_in_other_hands_is_named_and_not_opened(tmp_path: Path) -> None:
    """Two programs on a line garble it; the instrument is not asked then."""
    made_up = MadeUpMachine(tmp_path)
    made_up.holders["ttyUSB0"] = "minicom (process 99)"
    findings = await made_up.examine()
    assert findings["serial_port_free"].ok is False
    assert "minicom (process 99)" in findings["serial_port_free"].detail
    assert findings["instrument"].ok is None


async def test_modem_manager_is_noted_unless_it_is_kept_away(tmp_path: Path) -> None:
    """It talks to every line that is plugged in; the udev rules keep it away."""
    made_up = MadeUpMachine(tmp_path)
    made_up.commands["systemctl is-active ModemManager.service"] = "active\n"
    assert (await made_up.examine())["serial_port_free"].outcome is Outcome.NOTE
    made_up.write("etc/udev/rules.d/60-tsgt.rules", "")
    assert (await made_up.examine())["serial_port_free"].outcome is Outcome.OK


@pytest.mark.parametrize(
    ("timer_ms", "outcome"), [(16, Outcome.FAILED), (2, Outcome.OK), (1, Outcome.OK), (None, Outcome.OK)]
)
async def test_latency_timer_is_to_be_short(tmp_path: Path, timer_ms: int | None, outcome: Outcome) -> None:
    """16 ms are what an FTDI adapter has by itself; others have no such timer."""
    made_up = MadeUpMachine(tmp_path)
    made_up.latency_timer_ms = timer_ms
    found = (await made_up.examine())["latency_timer"]
    assert found.outcome is outcome
    if outcome is Outcome.FAILED:
        assert "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in found.detail
