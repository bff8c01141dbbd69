"""From a bare Debian and the offline bundle to measurements over the radio, as docs/how-to/set-up-a-pi.md says.

No file is edited by hand. Both machines are one guest here, with two radios: master and station are set up one after the
other. There is one total station, so that this ends with its measurements at the master; a pose needs three prisms.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
from vm import installation
from vm.guest import ADAPTER_PORT, Guest
from vm.image import PYTHON, ROOT, Image

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CONFIG_TXT = b"# as the image writer leaves it\ndtparam=audio=on\n#dtparam=spi=on\n"
MASTER = "tsgt setup master --spi-device spidev1.0 --gpio-chip /dev/gpiochip1"
STATION = "tsgt setup station --spi-device spidev0.0 --gpio-chip /dev/gpiochip0"
FIRST_MASTER = f"{MASTER} --yes --region CA915 --stations 3"
FIRST_STATION = f"{STATION} --yes --station 1 --prism-type mini_360 --mission mission.txt"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the bundle for the guest's Python; needs the network."""
    folder = tmp_path_factory.mktemp("bundle")
    script = [sys.executable, str(ROOT / "packaging/bundle.py"), "--output", str(folder), "--pythons", PYTHON]
    subprocess.run([*script, "amd64"], check=True, stdout=subprocess.DEVNULL)
    return folder


@pytest.fixture(scope="module")
def bare(bare_image: Image, kvm: bool, bundle: Path, run_folder: Path) -> Iterator[Guest]:  # noqa: FBT001 (a fixture)
    """Yield a guest without anything of tsgt, and with the bundle on a disk, as on a USB stick."""
    folder = run_folder / "setup"
    folder.mkdir(parents=True)
    disk = ["mke2fs", "-q", "-t", "ext4", "-L", "data", "-d", str(bundle), str(folder / "data.img"), "128M"]
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
    began_s, began_here_s = uptime_s(bare), time.monotonic()
    result = bare.run("dpkg -i /stick/*.deb", 900)
    assert result.code == 0, result.out
    took_s = time.monotonic() - began_here_s
    print(f"installation: {uptime_s(bare) - began_s:.0f} s of the guest, {took_s:.0f} s here")  # noqa: T201
    installation.start_far_ends(bare)
    bare.plug_adapter()
    bare.wait(f"test -e {ADAPTER_PORT}", 30)
    return bare


def test_one_sequence_leads_to_measurements(installed: Guest) -> None:
    """Install, set up the master, take its mission to the station, set that up: then its measurements arrive."""
    guest, began_s = installed, uptime_s(installed)
    made = steps(guest, FIRST_MASTER)
    assert guest.output("grep -c ^dtparam=spi=on /boot/firmware/config.txt") == "1"
    assert "BCM 25" in str(made["radio"]["detail"])
    guest.output("tsgt setup mission > mission.txt")
    made = steps(guest, FIRST_STATION)
    assert ADAPTER_PORT in str(made["instrument"]["detail"])
    assert guest.output("systemctl is-active tsgt-master tsgt-client").split() == ["active", "active"]
    guest.wait('grep -q \'"type":"measurement"\' /var/lib/tsgt/*.jsonl', 120)
    print(f"setup to the first measurement: {uptime_s(guest) - began_s:.0f} s of the guest")  # noqa: T201


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


def test_removal_leaves_configuration_and_recordings(installed: Guest) -> None:
    """And purging leaves the recordings."""
    installed.output("systemctl stop far-ends; dpkg --remove tsgt", 120)
    assert installed.run("systemctl is-active tsgt-master tsgt-client").code != 0
    assert installed.output("ls /etc/tsgt").split() == ["client.toml", "master.toml", "radio.key"]
    assert installed.output("ls /var/lib/tsgt/*.jsonl")
    assert installed.run("test -e /opt/tsgt -o -e /usr/bin/tsgt").code == 1
    installed.output("dpkg --purge tsgt")
    assert installed.run("ls -d /etc/tsgt").code != 0
    assert installed.output("ls /var/lib/tsgt/*.jsonl")
