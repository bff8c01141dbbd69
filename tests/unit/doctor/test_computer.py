"""The checks of ``tsgt doctor`` that look at users, services and clocks."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from harness.made_up_machine import MadeUpMachine

from tsgt.doctor import Outcome, current_user, find_user, group_name, run_command
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

CLOCK_SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
TIMEDATECTL = "timedatectl show --property=NTP --property=NTPSynchronized"


async def test_service_that_is_not_enabled_fails(tmp_path: Path) -> None:
    """A machine that has to be logged into after a power cut is not ready; the line says what to type."""
    made_up = MadeUpMachine(tmp_path)
    made_up.service = {"LoadState": "loaded", "UnitFileState": "disabled"}
    found = (await made_up.examine())["service"]
    assert found.ok is False
    assert "sudo systemctl enable tsgt-client" in found.detail


async def test_service_that_starts_again_and_again_fails(tmp_path: Path) -> None:
    """What systemd restarts for ever does not run, whatever it is enabled for."""
    made_up = MadeUpMachine(tmp_path)
    made_up.service = {"LoadState": "loaded", "UnitFileState": "enabled", "SubState": "auto-restart"}
    found = (await made_up.examine("master.toml"))["service"]
    assert found.ok is False
    assert "journalctl -u tsgt-master" in found.detail


async def test_machine_without_the_service_is_noted(tmp_path: Path) -> None:
    """Whoever starts the daemon by hand may do so, but is told."""
    made_up = MadeUpMachine(tmp_path)
    made_up.service = {"LoadState": "not-found"}
    findings = await made_up.examine()
    assert findings["service"].outcome is Outcome.NOTE
    assert "pi, who runs this" in findings["user"].detail


async def test_without_systemd_the_service_is_skipped(tmp_path: Path) -> None:
    """What cannot be asked has not failed."""
    made_up = MadeUpMachine(tmp_path)
    made_up.service = None
    assert (await made_up.examine())["service"].ok is None


async def test_service_with_another_configuration_is_noted(tmp_path: Path) -> None:
    """Checking one file while the service reads another one helps nobody."""
    made_up = MadeUpMachine(tmp_path)
    assert made_up.service is not None
    made_up.service["ExecStart"] = (
        "{ path=/opt/tsgt/bin/tsgt-client ; argv[]=/opt/tsgt/bin/tsgt-client --config /etc/tsgt/client.toml ; "
        "ignore_errors=no }"
    )
    found = (await made_up.examine())["service"]
    assert found.outcome is Outcome.NOTE
    assert "tsgt doctor /etc/tsgt/client.toml" in found.detail


async def test_user_of_the_service_who_does_not_exist_fails(tmp_path: Path) -> None:
    """A unit whose user or group is missing never starts."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = None
    found = (await made_up.examine())["user"]
    assert found.ok is False
    assert "spi gpio dialout" in found.detail


@pytest.mark.parametrize(
    ("name", "says", "outcome", "tells"),
    [
        ("client.toml", "NTP=yes\nNTPSynchronized=no\n", Outcome.NOTE, "sudo timedatectl set-ntp false"),
        ("client.toml", "NTP=no\nNTPSynchronized=no\n", Outcome.OK, "2026-11-21"),
        ("master.toml", "NTP=yes\nNTPSynchronized=no\n", Outcome.NOTE, "set-time"),
        ("master.toml", "NTP=yes\nNTPSynchronized=yes\n", Outcome.OK, "NTP has set the clock"),
        ("master.toml", "NTP=no\nNTPSynchronized=no\n", Outcome.OK, "nobody corrects"),
        ("master.toml", None, Outcome.SKIPPED, "no timedatectl"),
    ],
)
async def test_ntp_is_wanted_settled_or_not_at_all(
    tmp_path: Path, name: str, says: str | None, outcome: Outcome, tells: str
) -> None:
    """A client's clock is to be left alone; a master's may be corrected, before the daemon starts."""
    made_up = MadeUpMachine(tmp_path)
    made_up.commands = {} if says is None else {TIMEDATECTL: says}
    found = (await made_up.examine(name))["ntp"]
    assert found.outcome is outcome
    assert tells in found.detail


async def test_master_whose_clock_was_never_set_fails(tmp_path: Path) -> None:
    """Poses are in the master's time; a client may believe what it likes."""
    made_up = MadeUpMachine(tmp_path)
    made_up.now_ns = 1_000_000_000
    assert (await made_up.examine("master.toml"))["ntp"].ok is False
    assert (await made_up.examine("client.toml"))["ntp"].ok is True


async def test_slow_clock_source_is_noted(tmp_path: Path) -> None:
    """A PC that has given up its tsc still works."""
    made_up = MadeUpMachine(tmp_path)
    made_up.write(CLOCK_SOURCE, "hpet\n")
    assert (await made_up.examine())["clock_source"].outcome is Outcome.NOTE


async def test_machine_without_proc_and_sys_is_no_obstacle(tmp_path: Path) -> None:
    """What the kernel does not tell is noted or skipped."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / CLOCK_SOURCE).unlink()
    (tmp_path / "proc/sys/kernel/random/boot_id").unlink()
    findings = await made_up.examine()
    assert findings["clock_source"].outcome is Outcome.SKIPPED
    assert findings["boot_id"].outcome is Outcome.NOTE


def test_rights_go_by_the_mode_of_a_file(tmp_path: Path) -> None:
    """Owner, group and others are told apart as the kernel does it; a folder needs the right to enter, too."""
    device = tmp_path / "device"
    device.touch()
    found = device.stat()
    owner = User(name="owner", uid=found.st_uid or 1, groups=frozenset())
    member = User(name="member", uid=4711, groups=frozenset({found.st_gid}))
    stranger = User(name="stranger", uid=4712, groups=frozenset())
    for mode, users in (
        (0o060, {"member"}),
        (0o006, {"stranger"}),
        (0o040, set()),
        (0o666, {"member", "stranger"}),
    ):
        device.chmod(mode)
        assert {user.name for user in (member, stranger) if user.may_use(device)} == users
    if found.st_uid:  # else who runs the test is root, who may do everything
        device.chmod(0o600)
        assert owner.may_use(device)
    folder = tmp_path / "folder"
    folder.mkdir()
    for mode, may in ((0o060, False), (0o070, True)):
        folder.chmod(mode)
        assert member.may_use(folder) is may
    folder.chmod(0o700)


def test_this_machine_answers() -> None:
    """What is handed in from the machine that this runs on: its users, groups and commands."""
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
