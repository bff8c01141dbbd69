"""From a bare Debian and the offline bundle to the first pose, as docs/how-to/set-up-a-pi.md and calibrate.md say.

No file of the program is edited by hand. All machines are one guest here, with four radios: master and station 1 are set up on it,
stations 2 and 3 on a copy of its file system each, as the SD card of another Pi.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
from vm import field_notes, installation
from vm.guest import ADAPTER_PORT, Guest
from vm.image import PYTHON, ROOT, Image

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CONFIG_TXT = b"# as the image writer leaves it\ndtparam=audio=on\n#dtparam=spi=on\n"
MASTER = "tsgt setup master --spi-device spidev1.0 --gpio-chip /dev/gpiochip1"
STATION = "tsgt setup station --spi-device spidev0.0 --gpio-chip /dev/gpiochip0"
FIRST_MASTER = f"{MASTER} --yes --region CA915 --stations 3"
BUNDLE, NEWER, NEWER_BUNDLE = "tsgt.deb", "99.0.0", "newer.deb"
OTHER_STATIONS = (2, 3)
CALIBRATION = (
    "tsgt calibrate prisms prisms.csv --prism-constant-mm 10 --target-constant-mm 0 --apply /etc/tsgt/master.toml",
    "tsgt calibrate targets targets.csv --target-constant-mm 0 --apply /etc/tsgt/master.toml",
)
NEAR_M = 0.2
"""The first pose rests on a second of measurements: it is uncertain by some centimetres, and says so."""
CONFIGURATION = ["client.toml", "master.toml", "prism_layout.toml", "radio.key", "station_frames.toml"]
FIRST_STATION = f"{STATION} --yes --station 1 --prism-type mini_360 --mission mission.txt"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the bundle for the guest's Python, and a newer one; needs the network."""
    folder = tmp_path_factory.mktemp("bundle")
    script = [sys.executable, str(ROOT / "packaging/bundle.py"), "--output", str(folder), "--pythons", PYTHON]
    subprocess.run([*script, "amd64"], check=True, stdout=subprocess.DEVNULL)
    (package,) = folder.iterdir()
    package.rename(folder / BUNDLE)
    _newer(folder / BUNDLE, folder / NEWER_BUNDLE, tmp_path_factory.mktemp("newer"))
    return folder


def _newer(package: Path, newer: Path, folder: Path) -> None:
    """Make a package of another one in which tsgt has another version."""
    extract = ["dpkg-deb", "--raw-extract", str(package), str(folder)]
    subprocess.run(extract, check=True)
    (wheel,) = folder.glob("usr/share/tsgt/wheels/tsgt-*.whl")
    wheel.unlink()
    installation.build_wheel(wheel.parent, version=NEWER)
    control = folder / "DEBIAN/control"
    control.write_text(re.sub("^Version: .*", f"Version: {NEWER}", control.read_text(), flags=re.MULTILINE))
    command = ["dpkg-deb", "--root-owner-group", "-Znone", "--build", str(folder), str(newer)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def bare(bare_image: Image, kvm: bool, bundle: Path, run_folder: Path) -> Iterator[Guest]:  # noqa: FBT001 (a fixture)
    """Yield a guest without anything of tsgt, and with the bundles on a disk, as on a USB stick."""
    folder = run_folder / "setup"
    folder.mkdir(parents=True)
    disk = ["mke2fs", "-q", "-t", "ext4", "-L", "data", "-d", str(bundle), str(folder / "data.img"), "256M"]
    subprocess.run(disk, check=True)
    overlay = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", str(bare_image.disk.resolve())]
    subprocess.run([*overlay, str(folder / "root.qcow2")], check=True)
    with Guest(bare_image, folder, kvm=kvm) as guest:
        guest.start()
        # What the image has for the other tests.
        guest.output("rm -rf /opt/tsgt; groupdel spi; groupdel gpio; mkdir /stick && mount LABEL=data /stick")
        guest.push(CONFIG_TXT, "/boot/firmware/config.txt")
        yield guest


def uptime_s(guest: Guest) -> float:
    """Return the guest's time since it was switched on."""
    return float(guest.output("cut -d' ' -f1 /proc/uptime"))


def steps(guest: Guest, command: str) -> dict[str, dict[str, object]]:
    """Run a setup that must succeed; return its steps."""
    result = guest.run(f"{command} --json", 300)
    assert result.code == 0, result.out
    found = json.loads(result.out)
    assert found["ok"], found
    steps: dict[str, dict[str, object]] = found["steps"]
    return steps


@pytest.fixture(scope="module")
def installed(bare: Guest) -> Guest:
    """Install the bundle, and connect radios and instrument."""
    tell_uptime(bare, "installation begins")
    began_here_s = time.monotonic()
    result = bare.run(f"dpkg -i /stick/{BUNDLE}", 900)
    assert result.code == 0, result.out
    tell_uptime(bare, f"installed, in {time.monotonic() - began_here_s:.0f} s here,")
    installation.start_far_ends(bare)
    bare.plug_adapter()
    bare.wait(f"test -e {ADAPTER_PORT}", 30)
    return bare


def test_one_sequence_leads_to_poses(installed: Guest) -> None:
    """Set up the master, take its mission to the stations, set these up, calibrate: then there are valid poses."""
    guest = installed
    made = steps(guest, FIRST_MASTER)
    assert guest.output("grep -c ^dtparam=spi=on /boot/firmware/config.txt") == "1"
    assert "BCM 25" in str(made["radio"]["detail"])
    guest.output("tsgt setup mission > mission.txt")
    made = steps(guest, FIRST_STATION)
    assert ADAPTER_PORT in str(made["instrument"]["detail"])
    assert guest.output("systemctl is-active tsgt-master tsgt-client").split() == ["active", "active"]
    guest.wait('grep -q \'"type":"measurement"\' /var/lib/tsgt/*.jsonl', 120)
    tell_uptime(guest, "first measurement at the master")
    for station in OTHER_STATIONS:
        other_pi(guest, station)
    tell_uptime(guest, "three stations set up")
    guest.push(field_notes.targets().encode(), "/root/targets.csv")
    guest.push(field_notes.prisms().encode(), "/root/prisms.csv")
    for command in CALIBRATION:
        guest.output(command, 120)
    tell_uptime(guest, "calibrated")
    out = guest.output("timeout 120 tsgt listen --json --kind pose | grep -m 1 '\"valid\":true'", 150)
    tell_uptime(guest, "first valid pose")
    pose = json.loads(out)
    centre_m = field_notes.SCENARIO.motion.area_centre_m
    assert math.dist(pose["position_m"][:2], centre_m[:2]) < NEAR_M
    print(out)  # noqa: T201


def other_pi(guest: Guest, station: int) -> None:
    """Set up a station on a copy of the file system without tsgt's files, and run it beside the others, with files of its own."""
    root, layers = f"/srv/pi{station}", f"/run/pi{station}"
    guest.output(
        f"mkdir -p {root} {layers}/changes {layers}/work {layers}/run && "
        f"mount -t overlay overlay -o lowerdir=/,upperdir={layers}/changes,workdir={layers}/work {root} && "
        f"rm -rf {root}/etc/tsgt {root}/var/lib/tsgt && install -d -o tsgt -g tsgt {root}/var/lib/tsgt {layers}/run"
    )
    radio = f"--spi-device spidev{station}.0 --gpio-chip /dev/gpiochip{station}"
    answers = f"--station {station} --prism-type mini_360 --mission mission.txt --instrument /run/instrument.{station}.tty"
    assert steps(guest, f"tsgt setup station --root {root} --yes {radio} {answers}")["configuration"][
        "changed"
    ]
    binds = f"{root}/etc/tsgt:/etc/tsgt {root}/var/lib/tsgt:/var/lib/tsgt {layers}/run:/run/tsgt"
    unit = f"/run/systemd/system/tsgt-client{station}.service"
    guest.push(f"[Service]\nBindPaths={binds}\n".encode(), f"{unit}.d/files.conf")
    guest.output(
        f"cp /usr/lib/systemd/system/tsgt-client.service {unit}; systemctl daemon-reload; systemctl start tsgt-client{station}"
    )


def tell_uptime(guest: Guest, what: str) -> None:
    """Print the guest's time."""
    print(f"{what}: {uptime_s(guest):.0f} s after the guest was switched on")  # noqa: T201


def test_second_run_changes_nothing(installed: Guest) -> None:
    """With the daemons running, which own radio and instrument."""
    before = installed.output(
        "find /etc /boot/firmware /lib/systemd -type f -newermt 2000-01-01 -printf '%p %C@\\n' | sort"
    )
    for command in ("tsgt setup master --yes", "tsgt setup station --yes"):
        assert not any(step["changed"] for step in steps(installed, command).values())
    after = installed.output(
        "find /etc /boot/firmware /lib/systemd -type f -newermt 2000-01-01 -printf '%p %C@\\n' | sort"
    )
    assert after == before


def test_upgrade_restarts_what_runs(installed: Guest) -> None:
    """The daemons run on until the new environment is complete, and are restarted once."""
    pids = installed.output("systemctl show -P MainPID tsgt-master tsgt-client").split()
    recorded = 'grep -h \'"type":"measurement"\' $(ls -t /var/lib/tsgt/master-*.jsonl | head -1) | tail -1'
    installed.output("systemctl stop tsgt-client2 tsgt-client3")  # the package knows nothing of them
    upgrade = f"dpkg -i /stick/{NEWER_BUNDLE} > /root/upgrade.log 2>&1; echo $? > /root/upgraded"
    installed.output(f"systemd-run --quiet sh -c '{upgrade}'")
    installed.wait("ls -d /opt/.tsgt/??????/lib/*/site-packages/scipy | grep -c . | grep -q 2", 600)
    last = json.loads(installed.output(recorded))
    installed.wait(
        f"[ $({recorded} | grep -o '\"sequence\":[0-9]*' | cut -d: -f2) -gt {last['sequence']} ]", 60
    )
    assert installed.output("systemctl show -P MainPID tsgt-master tsgt-client").split() == pids
    installed.wait("test -e /root/upgraded", 600)
    assert installed.output("cat /root/upgraded").strip() == "0", installed.output("cat /root/upgrade.log")
    assert installed.output("systemctl is-active tsgt-master tsgt-client").split() == ["active", "active"]
    assert installed.output("tsgt --version").split()[-1] == NEWER
    assert len(installed.output("ls -d /opt/.tsgt/??????").split()) == 1
    installation.wait_for_measurements(installed, timeout_s=120)
    newest = installed.output("head -1 $(ls -t /var/lib/tsgt/master-*.jsonl | head -1)")
    assert json.loads(newest)["software"] == f"tsgt {NEWER}"
    assert installed.output("systemctl show -P NRestarts tsgt-master tsgt-client").split() == ["0", "0"]


def test_removal_leaves_configuration_and_recordings(installed: Guest) -> None:
    """And purging leaves the recordings."""
    installed.output("systemctl stop far-ends; dpkg --remove tsgt", 120)
    assert installed.run("systemctl is-active tsgt-master tsgt-client").code != 0
    assert installed.output("ls /etc/tsgt").split() == CONFIGURATION
    assert installed.output("ls /var/lib/tsgt/*.jsonl")
    assert installed.run("test -e /opt/tsgt -o -e /usr/bin/tsgt").code == 1
    installed.output("dpkg --purge tsgt")
    assert installed.run("ls -d /etc/tsgt").code != 0
    assert installed.output("ls /var/lib/tsgt/*.jsonl")
