"""The checks of ``tsgt doctor`` that look at configuration, key, set-up and disk."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from harness.made_up_machine import NOW_NS, MadeUpMachine

from tsgt.doctor import Outcome
from tsgt.doctor.machine import User

if TYPE_CHECKING:
    from pathlib import Path

HOUR_NS = 3600 * 1_000_000_000


@pytest.mark.parametrize("name", ["client.toml", "master.toml"])
async def test_machine_with_nothing_wrong_has_no_failure(tmp_path: Path, name: str) -> None:
    """But for the instrument, which is another test's, every check passes or says why it was not made."""
    findings = await MadeUpMachine(tmp_path).examine(name)
    assert [each for each in findings.values() if each.ok is False and each.name != "instrument"] == []


@pytest.mark.parametrize(
    ("old", "new", "tells"),
    [
        ("station = 1", "stationn = 1", "did you mean station?"),
        ("frequency_mhz = 869.525", "frequency_mhz = 905.0", "not within a band of EU868"),
    ],
)
async def test_configuration_that_is_refused_fails_and_the_rest_is_checked(
    tmp_path: Path, old: str, new: str, tells: str
) -> None:
    """What the daemon would not start with is the first line; what needs no configuration follows."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", old, new)
    findings = await made_up.examine()
    assert findings["configuration"].ok is False
    assert tells in findings["configuration"].detail
    assert set(findings) == {"configuration", "clock_source", "ntp", "boot_id"}


async def test_configuration_of_something_else_fails(tmp_path: Path) -> None:
    """A set-up file is no daemon's configuration, and a file that is not there is none either."""
    made_up = MadeUpMachine(tmp_path)
    assert "client or a master" in (await made_up.examine("frames.toml"))["configuration"].detail
    assert "no such file" in (await made_up.examine("nothing.toml"))["configuration"].detail


@pytest.mark.parametrize(
    ("file", "finding"),
    [("master.toml", "configuration"), ("frames.toml", "station_frames"), ("layout.toml", "prism_layout")],
)
async def test_file_that_everybody_may_write_fails(tmp_path: Path, file: str, finding: str) -> None:
    """The master would not start with it; the finding has the command that mends it."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / file).chmod(0o666)
    found = (await made_up.examine("master.toml"))[finding]
    assert found.ok is False
    assert f"chmod o-w {tmp_path / file}" in found.detail


async def test_missing_key_file_fails(tmp_path: Path) -> None:
    """The daemon would not start."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / "radio.key").unlink()
    found = (await made_up.examine())["key"]
    assert found.ok is False
    assert "tsgt radio key" in found.detail


async def test_key_that_others_may_read_fails(tmp_path: Path) -> None:
    """The line has the command that mends it."""
    made_up = MadeUpMachine(tmp_path)
    (tmp_path / "radio.key").chmod(0o644)
    assert "chmod 600" in (await made_up.examine())["key"].detail


async def test_key_that_is_none_fails(tmp_path: Path) -> None:
    """A file with the right owner and mode may still hold anything."""
    made_up = MadeUpMachine(tmp_path)
    made_up.write("radio.key", "secret")
    assert "not a key" in (await made_up.examine())["key"].detail


async def test_key_is_to_belong_to_the_daemons_user(tmp_path: Path) -> None:
    """A key that is right for who runs the checks is of no use to the service."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = User(name="tsgt", uid=os.geteuid() + 1, groups=frozenset({os.getegid()}))
    found = (await made_up.examine())["key"]
    assert found.ok is False
    assert "chown" in found.detail


async def test_no_key_is_noted(tmp_path: Path) -> None:
    """It works, and anybody can take part."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", 'key_file = "radio.key"', "")
    assert (await made_up.examine())["key"].outcome is Outcome.NOTE


async def test_protocol_without_a_key_is_skipped(tmp_path: Path) -> None:
    """The paper's protocol has none."""
    assert (await MadeUpMachine(tmp_path).examine("master.toml"))["key"].ok is None


async def test_setup_of_today_is_well(tmp_path: Path) -> None:
    """The lines tell how well the calibration went, and when."""
    findings = await MadeUpMachine(tmp_path).examine("master.toml")
    assert findings["station_frames"].outcome is Outcome.OK
    assert "1.4 mm at worst (station 3" in findings["station_frames"].detail
    assert "2 h ago" in findings["station_frames"].detail
    assert findings["prism_layout"].outcome is Outcome.OK
    assert "0.5 mm (one sigma)" in findings["prism_layout"].detail


async def test_frames_of_another_day_are_noted(tmp_path: Path) -> None:
    """Tripods that were put up anew need new frames; the robot has kept its prisms."""
    made_up = MadeUpMachine(tmp_path)
    for name in ("frames.toml", "layout.toml"):
        os.utime(tmp_path / name, ns=(NOW_NS, NOW_NS - 72 * HOUR_NS))
    findings = await made_up.examine("master.toml")
    assert findings["station_frames"].outcome is Outcome.NOTE
    assert "3 days ago" in findings["station_frames"].detail
    assert "tsgt calibrate check" in findings["station_frames"].detail
    assert findings["prism_layout"].outcome is Outcome.OK


async def test_age_is_not_told_by_a_wrong_clock(tmp_path: Path) -> None:
    """A file from the future shows that the clock is behind."""
    made_up = MadeUpMachine(tmp_path)
    os.utime(tmp_path / "frames.toml", ns=(NOW_NS, NOW_NS + HOUR_NS))
    found = (await made_up.examine("master.toml"))["station_frames"]
    assert found.outcome is Outcome.NOTE
    assert "not known" in found.detail


async def test_setup_by_hand_is_noted(tmp_path: Path) -> None:
    """Nobody has calibrated with the example that came with the program."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("frames.toml", "# written by", "# not written by anybody, as by")
    made_up.change("layout.toml", "# written by tsgt calibrate", "#")
    findings = await made_up.examine("master.toml")
    assert "is it the example?" in findings["prism_layout"].detail


@pytest.mark.parametrize(
    ("file", "old", "new", "name"),
    [
        ("frames.toml", "[stations.3]", "[stations.4]", "station_frames"),
        ("layout.toml", "[prisms.3]", "[prisms.4]", "prism_layout"),
        ("layout.toml", "[0.4844, -0.1759, 1.4167]", "[-0.4559, -0.1759, 1.1167]", "prism_layout"),
        ("master.toml", "frames.toml", "nothing.toml", "station_frames"),
    ],
)
async def test_setup_that_does_not_fit_fails(
    tmp_path: Path, file: str, old: str, new: str, name: str
) -> None:
    """A station without frame, a prism without position, two prisms in one place, no file: its own line says so."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change(file, old, new)
    findings = await made_up.examine("master.toml")
    assert [each.name for each in findings.values() if each.ok is False] == [name]


async def test_disk_with_little_room_fails(tmp_path: Path) -> None:
    """A journal of a day has to fit; the line tells the hours."""
    made_up = MadeUpMachine(tmp_path)
    made_up.free_bytes = 44_000_000
    found = (await made_up.examine())["disk"]
    assert found.ok is False
    assert "2.0 hours" in found.detail


@pytest.mark.parametrize("kind", ["tmpfs", "overlay"])
async def test_disk_that_is_memory_fails(tmp_path: Path, kind: str) -> None:
    """What is written there is gone with the power, however much room there is."""
    made_up = MadeUpMachine(tmp_path)
    made_up.write("proc/mounts", f"/dev/root / ext4 rw 0 0\nnone {tmp_path} {kind} rw 0 0\n")
    found = (await made_up.examine())["disk"]
    assert found.ok is False
    assert kind in found.detail


async def test_folder_that_is_not_there_is_made_by_the_service(tmp_path: Path) -> None:
    """With a unit systemd makes it; without one the user has to be able to."""
    made_up = MadeUpMachine(tmp_path)
    made_up.change("client.toml", 'directory = "journals"', 'directory = "new/journals"')
    findings = await made_up.examine()
    assert (findings["disk"].ok, findings["disk_write"].ok) == (True, None)
    made_up.service = None
    made_up.here = User(name="pi", uid=4711, groups=frozenset())
    found = (await made_up.examine())["disk"]
    assert found.ok is False
    assert "sudo install -d -o pi" in found.detail


async def test_folder_of_somebody_else_fails(tmp_path: Path) -> None:
    """The daemon would measure and write nothing."""
    made_up = MadeUpMachine(tmp_path)
    made_up.daemon = User(name="tsgt", uid=4711, groups=frozenset())
    found = (await made_up.examine())["disk"]
    assert found.ok is False
    assert "sudo chown -R tsgt" in found.detail


async def test_folder_that_the_unit_shuts_away_fails(tmp_path: Path) -> None:
    """A disk on which the user may write is of no use to a service that is not let in."""
    made_up = MadeUpMachine(tmp_path)
    assert made_up.service is not None
    made_up.service["ReadWritePaths"] = "-/media/disk"
    found = (await made_up.examine())["disk"]
    assert found.ok is False
    assert f"ReadWritePaths={tmp_path}/journals" in found.detail


async def test_writing_is_tried_and_leaves_nothing(tmp_path: Path) -> None:
    """What was written for the test is gone afterwards."""
    found = (await MadeUpMachine(tmp_path).examine())["disk_write"]
    assert found.outcome is Outcome.OK
    assert list((tmp_path / "journals").iterdir()) == []


@pytest.mark.parametrize(
    ("number", "tells"), [(30, "remount,rw"), (28, "No space left"), (13, "sudo tsgt doctor")]
)
async def test_disk_that_takes_nothing_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, tells: str
) -> None:
    """Mounted to be read only, full, or not for who runs the checks, which is no failure of the machine."""

    def refuse(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    found = (await MadeUpMachine(tmp_path).examine())["disk_write"]
    assert found.ok is (None if number == 13 else False)
    assert tells in found.detail
