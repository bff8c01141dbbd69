"""Checks of ``tsgt doctor``: configuration, key, set-up files and disk."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from harness.hardware.fake_machine import NOW_NS, FakeMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

HOUR_NS = 3600 * 1_000_000_000


@pytest.mark.parametrize("name", ["client.toml", "master.toml"])
async def test_ready_machine_has_no_failure(tmp_path: Path, name: str) -> None:
    """Every check passes or says why it was skipped."""
    findings = await FakeMachine(tmp_path).run_checks(name)
    assert [each for each in findings.values() if each.ok is False and each.name != "instrument"] == []


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("station = 1", "stationn = 1", "did you mean station?"),
        ("frequency_mhz = 869.85", "frequency_mhz = 905.0", "not within a band of EU868"),
    ],
)
async def test_invalid_configuration_fails_and_other_checks_run(
    tmp_path: Path, old: str, new: str, expected: str
) -> None:
    """It is the first finding; checks without configuration follow."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", old, new)
    findings = await fake.run_checks()
    assert findings["configuration"].ok is False
    assert expected in findings["configuration"].detail
    assert set(findings) == {"configuration", "clock_source", "ntp", "boot_id"}


async def test_file_of_another_kind_fails(tmp_path: Path) -> None:
    """A set-up file or a missing file is no configuration."""
    fake = FakeMachine(tmp_path)
    assert "client or a master" in (await fake.run_checks("frames.toml"))["configuration"].detail
    assert "no such file" in (await fake.run_checks("nothing.toml"))["configuration"].detail


@pytest.mark.parametrize(
    ("file", "finding"),
    [("master.toml", "configuration"), ("frames.toml", "station_frames"), ("layout.toml", "prism_layout")],
)
async def test_world_writable_file_fails(tmp_path: Path, file: str, finding: str) -> None:
    """The finding has the command that fixes it."""
    fake = FakeMachine(tmp_path)
    (tmp_path / file).chmod(0o666)
    found = (await fake.run_checks("master.toml"))[finding]
    assert found.ok is False
    assert f"chmod o-w {tmp_path / file}" in found.detail


MOUNTING = """\
# written by tsgt calibrate imu
kind = "imu_mounting"
position_m = [0.21, -0.12, 0.43]
orientation_xyzw = [0.0, 0.0, 0.0, 1.0]
latency_ms = 4.3
gyro_matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

[covariance]
components = ["imu.x", "imu.rotation_z"]
matrix = [[4e-6, 0.0], [0.0, 1e-6]]
"""


@pytest.mark.parametrize(
    ("text", "mode", "outcome", "expected"),
    [
        (MOUNTING, 0o644, Outcome.OK, "one sigma up to 2.0 mm and 0.06 deg"),
        (MOUNTING, 0o666, Outcome.FAILED, "chmod o-w"),
        (MOUNTING.replace("latency_ms", "latency"), 0o644, Outcome.FAILED, "did you mean latency_ms?"),
        (MOUNTING.partition("\n")[2], 0o644, Outcome.NOTE, "not written by `tsgt calibrate imu`"),
        (None, 0o644, Outcome.FAILED, "no such file"),
    ],
)
async def test_mounting_of_the_imu_is_a_set_up_file(
    tmp_path: Path, text: str | None, mode: int, outcome: Outcome, expected: str
) -> None:
    """Poses depend on it as on the frames."""
    fake = FakeMachine(tmp_path)
    table = '[imu]\ncommand = ["imu-program"]\nmounting = "mounting.toml"\nlatitude_deg = 46.8\n\n'
    fake.change("master.toml", "[[stations]]\nstation = 1", f"{table}[[stations]]\nstation = 1")
    if text is not None:
        (tmp_path / "mounting.toml").write_text(text)
        (tmp_path / "mounting.toml").chmod(mode)
        os.utime(tmp_path / "mounting.toml", ns=(NOW_NS - HOUR_NS, NOW_NS - HOUR_NS))
    findings = await fake.run_checks("master.toml")
    assert (findings["imu_mounting"].outcome, "stations" in findings) == (outcome, False)
    assert expected in findings["imu_mounting"].detail


async def test_missing_key_file_fails(tmp_path: Path) -> None:
    """The daemon would not start."""
    fake = FakeMachine(tmp_path)
    (tmp_path / "radio.key").unlink()
    found = (await fake.run_checks())["key"]
    assert found.ok is False
    assert "tsgt radio key" in found.detail


async def test_key_readable_by_others_fails(tmp_path: Path) -> None:
    """The finding has the command that fixes it."""
    fake = FakeMachine(tmp_path)
    (tmp_path / "radio.key").chmod(0o644)
    assert "chmod 600" in (await fake.run_checks())["key"].detail


async def test_invalid_key_fails(tmp_path: Path) -> None:
    """Owner and mode are right, the content is not."""
    fake = FakeMachine(tmp_path)
    fake.write("radio.key", "secret")
    assert "not a key" in (await fake.run_checks())["key"].detail


async def test_key_must_belong_to_the_daemon_user(tmp_path: Path) -> None:
    """A key of the user who runs the checks does not help the service."""
    fake = FakeMachine(tmp_path)
    fake.daemon = User(name="tsgt", uid=os.geteuid() + 1, groups=frozenset({os.getegid()}))
    found = (await fake.run_checks())["key"]
    assert found.ok is False
    assert "chown" in found.detail


async def test_no_key_is_a_note(tmp_path: Path) -> None:
    """Anybody can take part."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'key_file = "radio.key"', "")
    assert (await fake.run_checks())["key"].outcome is Outcome.NOTE


async def test_protocol_without_a_key_is_skipped(tmp_path: Path) -> None:
    """Classic has no key."""
    assert (await FakeMachine(tmp_path).run_checks("master.toml"))["key"].ok is None


async def test_recent_set_up_passes(tmp_path: Path) -> None:
    """The findings have quality and age."""
    findings = await FakeMachine(tmp_path).run_checks("master.toml")
    assert findings["station_frames"].outcome is Outcome.OK
    assert "up to 1.4 mm rms (station 3" in findings["station_frames"].detail
    assert "2 h ago" in findings["station_frames"].detail
    assert findings["prism_layout"].outcome is Outcome.OK
    assert "one sigma up to 0.5 mm" in findings["prism_layout"].detail


async def test_old_frames_are_a_note(tmp_path: Path) -> None:
    """Moved tripods need new frames; the prism layout stays."""
    fake = FakeMachine(tmp_path)
    for name in ("frames.toml", "layout.toml"):
        os.utime(tmp_path / name, ns=(NOW_NS, NOW_NS - 72 * HOUR_NS))
    findings = await fake.run_checks("master.toml")
    assert findings["station_frames"].outcome is Outcome.NOTE
    assert "3 days ago" in findings["station_frames"].detail
    assert "tsgt calibrate check" in findings["station_frames"].detail
    assert findings["prism_layout"].outcome is Outcome.OK


async def test_age_is_unknown_with_a_wrong_clock(tmp_path: Path) -> None:
    """A file from the future shows that the clock is behind."""
    fake = FakeMachine(tmp_path)
    os.utime(tmp_path / "frames.toml", ns=(NOW_NS, NOW_NS + HOUR_NS))
    found = (await fake.run_checks("master.toml"))["station_frames"]
    assert found.outcome is Outcome.NOTE
    assert "unknown" in found.detail


async def test_example_set_up_is_a_note(tmp_path: Path) -> None:
    """Nobody has calibrated with the example files."""
    fake = FakeMachine(tmp_path)
    fake.change("frames.toml", "# written by", "# not written by anybody, as by")
    fake.change("layout.toml", "# written by tsgt calibrate", "#")
    findings = await fake.run_checks("master.toml")
    assert "is it the example?" in findings["prism_layout"].detail


@pytest.mark.parametrize(
    ("file", "old", "new", "name"),
    [
        ("frames.toml", "[stations.3]", "[stations.4]", "station_frames"),
        ("layout.toml", "[prisms.3]", "[prisms.4]", "prism_layout"),
        ("layout.toml", "[0.4844, -0.1759, 1.4167]", "[-0.4559, -0.1759, 1.1167]", "prism_layout"),
    ],
)
async def test_inconsistent_set_up_fails(tmp_path: Path, file: str, old: str, new: str, name: str) -> None:
    """A missing frame or prism, and coincident prisms are each reported for their file."""
    fake = FakeMachine(tmp_path)
    fake.change(file, old, new)
    findings = await fake.run_checks("master.toml")
    assert [each.name for each in findings.values() if each.ok is False] == [name]


@pytest.mark.parametrize(
    ("file", "name", "command"),
    [("frames.toml", "station_frames", "targets"), ("layout.toml", "prism_layout", "prisms")],
)
async def test_missing_calibration_is_a_note(tmp_path: Path, file: str, name: str, command: str) -> None:
    """The master starts without it, and the note says how it is made."""
    fake = FakeMachine(tmp_path)
    (tmp_path / file).unlink()
    findings = await fake.run_checks("master.toml")
    assert [each.name for each in findings.values() if each.ok is False] == []
    assert findings[name].outcome is Outcome.NOTE
    assert f"without poses until `tsgt calibrate {command} ... --apply` writes it" in findings[name].detail


async def test_disk_with_little_space_fails(tmp_path: Path) -> None:
    """The finding states the hours."""
    fake = FakeMachine(tmp_path)
    fake.free_bytes = 44_000_000
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert "2.0 hours" in found.detail


@pytest.mark.parametrize("kind", ["tmpfs", "overlay"])
async def test_disk_in_memory_fails(tmp_path: Path, kind: str) -> None:
    """It loses everything at a power cut."""
    fake = FakeMachine(tmp_path)
    fake.write("proc/mounts", f"/dev/root / ext4 rw 0 0\nnone {tmp_path} {kind} rw 0 0\n")
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert kind in found.detail


async def test_missing_folder_is_created_by_the_service(tmp_path: Path) -> None:
    """Without a unit the user must be able to create it."""
    fake = FakeMachine(tmp_path)
    fake.change("client.toml", 'directory = "journals"', 'directory = "new/journals"')
    findings = await fake.run_checks()
    assert (findings["disk"].ok, findings["disk_write"].ok) == (True, None)
    fake.service = None
    fake.here = User(name="pi", uid=4711, groups=frozenset())
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert "sudo install -d -o pi" in found.detail


async def test_folder_of_another_user_fails(tmp_path: Path) -> None:
    """The daemon could not write."""
    fake = FakeMachine(tmp_path)
    fake.daemon = User(name="tsgt", uid=4711, groups=frozenset())
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert "sudo chown -R tsgt" in found.detail


async def test_folder_outside_the_sandbox_fails(tmp_path: Path) -> None:
    """Permissions do not help a sandboxed service."""
    fake = FakeMachine(tmp_path)
    assert fake.service is not None
    fake.service["ReadWritePaths"] = "-/media/disk"
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert f"ReadWritePaths={tmp_path}/journals" in found.detail


@pytest.mark.parametrize("permitted", ["", "/home"])
async def test_folder_in_a_home_is_hidden_from_the_service(tmp_path: Path, permitted: str) -> None:
    """ReadWritePaths does not help there, so it is not advised."""
    fake = FakeMachine(tmp_path)
    assert fake.service is not None
    fake.service["ReadWritePaths"] = permitted
    fake.change("client.toml", 'directory = "journals"', 'directory = "/home/pi/journal"')
    found = (await fake.run_checks())["disk"]
    assert found.ok is False
    assert "hides /home/pi/journal: configure a folder outside" in found.detail
    assert "ReadWritePaths" not in found.detail


async def test_write_test_leaves_nothing(tmp_path: Path) -> None:
    """The test file is removed."""
    found = (await FakeMachine(tmp_path).run_checks())["disk_write"]
    assert found.outcome is Outcome.OK
    assert list((tmp_path / "journals").iterdir()) == []


@pytest.mark.parametrize(
    ("number", "expected"), [(30, "remount,rw"), (28, "No space left"), (13, "sudo tsgt doctor")]
)
async def test_unwritable_disk_reports_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, expected: str
) -> None:
    """Read-only, full, or no permission for the user of the checks, which is no failure."""

    def refuse(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    found = (await FakeMachine(tmp_path).run_checks())["disk_write"]
    assert found.ok is (None if number == 13 else False)
    assert expected in found.detail
