"""Checks of ``tsgt doctor``: users, services and clocks."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from harness.hardware.fake_machine import FakeMachine

from tsgt.doctor import Outcome, current_user, find_user, group_name, run_command
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

CLOCK_SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
TIMEDATECTL = "timedatectl show --property=NTP --property=NTPSynchronized"


async def test_disabled_service_fails(tmp_path: Path) -> None:
    """The finding says what to type."""
    fake = FakeMachine(tmp_path)
    fake.service = {"LoadState": "loaded", "UnitFileState": "disabled"}
    found = (await fake.run_checks())["service"]
    assert found.ok is False
    assert "sudo systemctl enable tsgt-client" in found.detail


async def test_restarting_service_fails(tmp_path: Path) -> None:
    """An enabled service may still fail repeatedly."""
    fake = FakeMachine(tmp_path)
    fake.service = {"LoadState": "loaded", "UnitFileState": "enabled", "SubState": "auto-restart"}
    found = (await fake.run_checks("master.toml"))["service"]
    assert found.ok is False
    assert "journalctl -u tsgt-master" in found.detail


async def test_missing_service_is_a_note(tmp_path: Path) -> None:
    """The daemon may be started by hand."""
    fake = FakeMachine(tmp_path)
    fake.service = {"LoadState": "not-found"}
    findings = await fake.run_checks()
    assert findings["service"].outcome is Outcome.NOTE
    assert "pi, who runs this" in findings["user"].detail


async def test_service_is_skipped_without_systemd(tmp_path: Path) -> None:
    """The state is unknown."""
    fake = FakeMachine(tmp_path)
    fake.service = None
    assert (await fake.run_checks())["service"].ok is None


async def test_service_with_another_configuration_is_a_note(tmp_path: Path) -> None:
    """The service reads another file than the checked one."""
    fake = FakeMachine(tmp_path)
    assert fake.service is not None
    fake.service["ExecStart"] = (
        "{ path=/opt/tsgt/bin/tsgt-client ; argv[]=/opt/tsgt/bin/tsgt-client --config /etc/tsgt/client.toml ; "
        "ignore_errors=no }"
    )
    found = (await fake.run_checks())["service"]
    assert found.outcome is Outcome.NOTE
    assert "tsgt doctor /etc/tsgt/client.toml" in found.detail


async def test_missing_service_user_fails(tmp_path: Path) -> None:
    """A unit with a missing user or group never starts."""
    fake = FakeMachine(tmp_path)
    fake.daemon = None
    found = (await fake.run_checks())["user"]
    assert found.ok is False
    assert "spi gpio dialout" in found.detail


@pytest.mark.parametrize(
    ("name", "says", "outcome", "expected"),
    [
        ("client.toml", "NTP=yes\nNTPSynchronized=no\n", Outcome.NOTE, "sudo timedatectl set-ntp false"),
        ("client.toml", "NTP=no\nNTPSynchronized=no\n", Outcome.OK, "2026-11-21"),
        ("master.toml", "NTP=yes\nNTPSynchronized=no\n", Outcome.NOTE, "set-time"),
        ("master.toml", "NTP=yes\nNTPSynchronized=yes\n", Outcome.OK, "NTP has set the clock"),
        ("master.toml", "NTP=no\nNTPSynchronized=no\n", Outcome.OK, "does not steer"),
        ("master.toml", None, Outcome.SKIPPED, "timedatectl does not respond"),
    ],
)
async def test_ntp_outcome_by_daemon_and_state(
    tmp_path: Path, name: str, says: str | None, outcome: Outcome, expected: str
) -> None:
    """A client's clock must not be steered; a master's may be, before the daemon starts."""
    fake = FakeMachine(tmp_path)
    fake.commands = {} if says is None else {TIMEDATECTL: says}
    found = (await fake.run_checks(name))["ntp"]
    assert found.outcome is outcome
    assert expected in found.detail


async def test_master_with_unset_clock_fails(tmp_path: Path) -> None:
    """Poses use the master's time; a client's time does not matter."""
    fake = FakeMachine(tmp_path)
    fake.now_ns = 1_000_000_000
    assert (await fake.run_checks("master.toml"))["ntp"].ok is False
    assert (await fake.run_checks("client.toml"))["ntp"].ok is True


async def test_slow_clock_source_is_a_note(tmp_path: Path) -> None:
    """A PC without tsc still works."""
    fake = FakeMachine(tmp_path)
    fake.write(CLOCK_SOURCE, "hpet\n")
    assert (await fake.run_checks())["clock_source"].outcome is Outcome.NOTE


async def test_missing_proc_and_sys_is_no_failure(tmp_path: Path) -> None:
    """The checks are notes or skipped."""
    fake = FakeMachine(tmp_path)
    (tmp_path / CLOCK_SOURCE).unlink()
    (tmp_path / "proc/sys/kernel/random/boot_id").unlink()
    findings = await fake.run_checks()
    assert findings["clock_source"].outcome is Outcome.SKIPPED
    assert findings["boot_id"].outcome is Outcome.NOTE


def test_permissions_follow_the_mode(tmp_path: Path) -> None:
    """Owner, group and others as in the kernel; a folder needs execute permission."""
    device = tmp_path / "device"
    device.touch()
    found = device.stat()
    owner = User(name="owner", uid=found.st_uid or 1, groups=frozenset())
    member = User(name="member", uid=4711, groups=frozenset({found.st_gid}))
    other = User(name="other", uid=4712, groups=frozenset())
    for mode, users in (
        (0o060, {"member"}),
        (0o006, {"other"}),
        (0o040, set()),
        (0o666, {"member", "other"}),
    ):
        device.chmod(mode)
        assert {user.name for user in (member, other) if user.may_use(device)} == users
    if found.st_uid:  # unless the test runs as root
        device.chmod(0o600)
        assert owner.may_use(device)
    folder = tmp_path / "folder"
    folder.mkdir()
    for mode, may in ((0o060, False), (0o070, True)):
        folder.chmod(mode)
        assert member.may_use(folder) is may
    folder.chmod(0o700)


def test_interface_to_this_machine() -> None:
    """Users, groups and commands of this machine."""
    assert current_user().uid == os.geteuid()
    root = find_user("root", [])
    assert root is not None
    assert root.uid == 0
    assert find_user("nobody-of-this-name", []) is None
    assert find_user("root", ["no-group-of-this-name"]) is None
    assert group_name(0) == "root"
    assert group_name(4_000_000) == "4000000"
    assert run_command(["echo", "word"]) == "word\n"
    assert run_command(["false"]) is None
    assert run_command(["no-command-of-this-name"]) is None
