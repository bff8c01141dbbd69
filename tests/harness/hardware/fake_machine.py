"""A fake machine in a temporary folder for the checks of ``tsgt doctor``: its devices are plain files."""

from __future__ import annotations

import hashlib
import os
from typing import TYPE_CHECKING

import numpy as np
from harness.hardware.radios import running_timeline

from tsgt.doctor import Machine, run_checks
from tsgt.doctor.machine import User
from tsgt.errors import InstrumentError
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel, SimulatedHal, SX1276Chip

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.doctor import Finding
    from tsgt.radio.sx127x import Hal, Wiring
    from tsgt.service import StartProgram
    from tsgt.station import ClientStatus
    from tsgt.station.serial import OpenPort, Port

NOW_NS = 1_795_260_000_000_000_000
"""2026-11-21."""

ADAPTER = "usb-FTDI_FT232R_USB_UART_A9012345-if00-port0"

CLIENT = f"""
kind = "client"
station = 1
prism = 1
status_socket = "client.sock"
[instrument]
kind = "leica"
port = "dev/serial/by-id/{ADAPTER}"
prism_type = "mini_360"
[radio]
kind = "sx127x"
frequency_mhz = 869.85
spreading_factor = 7
region = "EU868"
[protocol]
kind = "superframe"
key_file = "radio.key"
[journal]
directory = "journals"
"""

MASTER = """
kind = "master"
[setup]
station_frames = "frames.toml"
prism_layout = "layout.toml"
[radio]
kind = "sx127x"
frequency_mhz = 905.0
spreading_factor = 9
bandwidth_khz = 500.0
region = "CA915"
[protocol]
kind = "classic"
[stream]
socket = "poses.sock"
[recording]
directory = "recordings"
[[stations]]
station = 1
prism = 1
prism_constant_mm = 10.0
[[stations]]
station = 2
prism = 2
prism_constant_mm = 10.0
[[stations]]
station = 3
prism = 3
prism_constant_mm = 10.0
"""

FRAMES = """# written by tsgt calibrate targets day.csv
kind = "station_frames"
[stations.1]
T_station1_station = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
[stations.2]
T_station1_station = [[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
rms_mm = 0.8
[stations.3]
T_station1_station = [[1.0, 0.0, 0.0, 4.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
rms_mm = 1.4
"""

LAYOUT = """# written by tsgt calibrate prisms robot.csv
kind = "prism_layout"
[prisms.1]
position_m = [-0.4559, -0.1759, 1.1167]
sigma_m = [0.0004, 0.0005, 0.0003]
[prisms.2]
position_m = [0.4844, -0.1759, 1.4167]
[prisms.3]
position_m = [-0.0285, 0.3519, 1.0667]
"""

ENABLED = {
    "LoadState": "loaded",
    "UnitFileState": "enabled",
    "ActiveState": "inactive",
    "SubState": "dead",
    "User": "tsgt",
    "SupplementaryGroups": "spi gpio dialout",
    "ProtectSystem": "strict",
    "StateDirectory": "tsgt",
    "ProtectHome": "yes",
    "PrivateNetwork": "yes",
    "RestrictAddressFamilies": "AF_UNIX",
    "IPAddressAllow": "",
    "IPAddressDeny": "0.0.0.0/0 ::/0",
}


class HalWithoutDio0(SimulatedHal):
    """A chip whose DIO0 is not wired."""

    def dio0(self) -> bool:
        """Return the level of a pin with a pull-down."""
        return False


class FakeMachine:
    """The machine interface, at first without problems; a test changes what it is about.

    Attributes
    ----------
    folder
        Holds the configurations, and under ``dev``, ``sys``, ``proc`` and ``etc`` the system.
    service
        What systemd says of the daemon's unit; None: no systemd answers.
    commands
        What other commands print, by all their words.
    here, daemon
        The user who runs the checks, and the one who runs the service.
    unreached
        What is wrong with the web server of the alarms.
    reached
        Addresses that were connected to.
    holders
        Who has a device open, by its name.
    port
        Opens the line to the instrument.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now_ns = NOW_NS
        self.here = User(name="pi", uid=os.geteuid(), groups=frozenset({os.getegid()}))
        self.daemon: User | None = User(name="tsgt", uid=os.geteuid(), groups=frozenset({os.getegid()}))
        self.service: dict[str, str] | None = {**ENABLED, "ReadWritePaths": str(folder)}
        self.commands: dict[str, str] = {
            "timedatectl show --property=NTP --property=NTPSynchronized": "NTP=no\nNTPSynchronized=no\n"
        }
        self.holders: dict[str, str] = {}
        self.latency_timer_ms: int | None = 1
        self.free_bytes = 30_000_000_000
        self.programs: set[str] = set()
        self.start_imu: StartProgram | None = None
        self.start_odometry: StartProgram | None = None
        self.status: ClientStatus | None = None
        self.served: set[Path] = set()
        self.unreached = ""
        self.reached: list[str] = []
        self.hal_error: Exception | None = None
        self.dio0_connected = True
        self.port: OpenPort = self._nothing_answers
        self._make_system()
        self.write("client.toml", CLIENT)
        self.write("master.toml", MASTER)
        for name, text in (("frames.toml", FRAMES), ("layout.toml", LAYOUT)):
            path = self.write(name, text)
            os.utime(path, ns=(NOW_NS, NOW_NS - 2 * 3600 * 1_000_000_000))
        self.write("radio.key", hashlib.sha256(b"a key").hexdigest() + "\n").chmod(0o600)
        for name in ("journals", "recordings"):
            (folder / name).mkdir()

    @property
    def tty(self) -> Path:
        """Device of the serial adapter."""
        return self.folder / "dev" / "ttyUSB0"

    def write(self, name: str, text: str) -> Path:
        """Write a file, with its folders."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def change(self, name: str, old: str, new: str) -> None:
        """Change the text of a file."""
        path = self.folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def machine(self) -> Machine:
        """Return the interface for the checks."""
        return Machine(
            dev=self.folder / "dev",
            sys=self.folder / "sys",
            proc=self.folder / "proc",
            etc=self.folder / "etc",
            clock=VirtualClock(self.now_ns),
            user=self.here,
            find_user=lambda _name, _groups: self.daemon,
            group_name=lambda gid: "dialout" if gid else "root",
            run=self._run,
            which=lambda program: (
                f"{'' if program.startswith('/') else '/usr/bin/'}{program}"
                if program in self.programs
                else None
            ),
            free_bytes=lambda _folder: self.free_bytes,
            start_imu=self.start_imu,
            start_odometry=self.start_odometry,
            port_holder=lambda path: self.holders.get(path.name),
            latency_timer_ms=lambda _path: self.latency_timer_ms,
            open_port=lambda _path: self.port,
            open_hal=self._open_hal,
            client_status=self.ask_client,
            serves=lambda path: path in self.served,
            reach=self._reach,
        )

    async def run_checks(self, name: str = "client.toml") -> dict[str, Finding]:
        """Run all checks; return the findings by name."""
        found = [finding async for finding in run_checks(self.machine(), self.folder / name)]
        by_name = {finding.name: finding for finding in found}
        assert len(by_name) == len(found)
        return by_name

    def ask_client(self, _path: Path) -> ClientStatus | None:
        """Return the status of the client."""
        return self.status

    def _reach(self, url: str) -> str:
        self.reached.append(url)
        return self.unreached

    def _make_system(self) -> None:
        for name in ("dev/spidev0.0", "dev/gpiochip0", "dev/ttyUSB0"):
            self.write(name, "").chmod(0o660)
        by_id = self.folder / "dev" / "serial" / "by-id"
        by_id.mkdir(parents=True)
        (by_id / ADAPTER).symlink_to("../../ttyUSB0")
        self.write("sys/devices/system/clocksource/clocksource0/current_clocksource", "arch_sys_counter\n")
        self.write("proc/sys/kernel/random/boot_id", "11111111-2222-3333-4444-555555555555\n")
        self.write("proc/mounts", "/dev/mmcblk0p2 / ext4 rw,noatime 0 0\n")

    def _run(self, arguments: Sequence[str]) -> str | None:
        if arguments[:2] == ["systemctl", "show"]:
            pairs = None if self.service is None else self.service.items()
            return None if pairs is None else "".join(f"{key}={value}\n" for key, value in pairs)
        return self.commands.get(" ".join(arguments))

    def _open_hal(self, _wiring: Wiring) -> Hal:
        if self.hal_error is not None:
            raise self.hal_error
        timeline = running_timeline()
        air = Air(timeline, np.random.default_rng(0), LinkModel())
        chip = SX1276Chip(timeline, lambda antenna: air.join(antenna, "here"), np.random.default_rng(1))
        return SimulatedHal(chip) if self.dio0_connected else HalWithoutDio0(chip)

    async def _nothing_answers(self, baud: int) -> Port:
        raise InstrumentError(f"nothing answers at {baud}")
