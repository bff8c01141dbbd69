"""A Raspberry Pi to set up, as a folder with its root file system, its commands, and what is soldered to it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.hardware.fake_machine import ADAPTER, FakeMachine
from harness.hardware.radios import running_timeline

from tsgt.config import ScenarioConfig, TcpAddress
from tsgt.setup import Ran, System
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel, SimulatedHal, SX1276Chip
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.doctor import Machine
    from tsgt.radio.sx127x import EdgeCallback, Hal, Wiring
    from tsgt.station.serial import OpenPort

OS_RELEASE = 'PRETTY_NAME="Raspberry Pi OS (bookworm)"\nID=debian\nVERSION_ID="12"\n'
CONFIG_TXT = "# Raspberry Pi\ndtparam=audio=on\n#dtparam=spi=on\n[pi4]\narm_boost=1\n"


class Unconnected:
    """Bus and pins with no chip at this chip select: the bus reads as zeros."""

    stamp_sigma_ns = 10_000

    def transfer(self, data: bytes) -> bytes:
        """Read zeros."""
        return bytes(len(data))

    def set_reset(self, *, low: bool) -> None:
        """Drive a pin that is connected to nothing."""

    def dio0(self) -> bool:
        """Read a pin that is pulled down."""
        return False

    def on_dio0(self, callback: EdgeCallback) -> None:
        """Wait for edges that never come."""

    def close(self) -> None:
        """Release it."""


class PiToSetUp:
    """A Pi as it comes from the image writer, with a radio and an instrument that it does not know yet.

    Attributes
    ----------
    root
        Its root file system.
    nss_pin
        What the radio's chip select is connected to; -1: the SPI controller; None: there is no radio.
    instruments
        By the name of the adapter, the baud rate that its instrument is set to; None: it is off.
    commands
        All commands that were run, but for questions.
    spi_at_boot
        Whether SPI takes a reboot.
    interrupted_at
        Command instead of which the operator presses Ctrl-C, once; empty: none.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.nss_pin: int | None = 25
        self.instruments: dict[str, int | None] = {ADAPTER: 115_200}
        self.commands: list[str] = []
        self.spi_at_boot = False
        self.interrupted_at = ""
        self.uid = 0
        self.operator: str | None = "pi"
        self.active: set[str] = set()
        self.ntp = True
        self.python = (3, 11)
        self.write("etc/os-release", OS_RELEASE)
        self.write("etc/passwd", "root:x:0:0::/root:/bin/bash\npi:x:1000:1000::/home/pi:/bin/bash\n")
        self.write("etc/group", "root:x:0:\ndialout:x:20:pi\ntty:x:5:\nspi:x:990:pi\n")
        self.write("boot/firmware/config.txt", CONFIG_TXT)
        self.write("dev/gpiochip0", "").chmod(0o660)
        (root / "dev/serial/by-id").mkdir(parents=True)
        self._fake = FakeMachine(root.parent / "machine")
        self._fake.folder = root
        self._fake.service = None
        self.plug_in(ADAPTER, 115_200)

    def write(self, name: str, text: str) -> Path:
        """Write a file of the system, with its folders."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def plug_in(self, adapter: str, baud: int | None) -> None:
        """Connect an instrument by an adapter."""
        number = len(list((self.root / "dev/serial/by-id").iterdir()))
        self.write(f"dev/ttyUSB{number}", "").chmod(0o660)
        (self.root / "dev/serial/by-id" / adapter).symlink_to(f"../../ttyUSB{number}")
        self.instruments[adapter] = baud

    def boot(self) -> None:
        """Apply what only the boot loader applies."""
        if "\ndtparam=spi=on" in (self.root / "boot/firmware/config.txt").read_text():
            self.write("dev/spidev0.0", "").chmod(0o660)

    def system(self) -> System:
        """Return the system as the setup sees it, running."""
        return System(
            root=self.root,
            uid=self.uid,
            operator=self.operator,
            python=self.python,
            run=self._run,
            change_owner=self._change_owner,
        )

    def machine(self) -> Machine:
        """Return the interface of doctor and probes."""
        return replace(self._fake.machine(), open_hal=self._open_hal, open_port=self._open_port)

    def files(self) -> dict[str, bytes]:
        """Return the content of all files that are not devices."""
        return {
            str(path.relative_to(self.root)): path.read_bytes()
            for path in sorted(self.root.rglob("*"))
            if path.is_file() and not path.is_symlink()
        }

    def _change_owner(self, path: Path, uid: int, gid: int) -> None:
        """Keep the owner: all files here belong to the user who runs the test."""

    def _open_hal(self, wiring: Wiring) -> Hal:
        if self.nss_pin is None or wiring.nss_pin != (None if self.nss_pin < 0 else self.nss_pin):
            return Unconnected()
        timeline = running_timeline()
        air = Air(timeline, np.random.default_rng(0), LinkModel())
        return SimulatedHal(
            SX1276Chip(timeline, lambda antenna: air.join(antenna, "here"), np.random.default_rng(1))
        )

    def _open_port(self, path: Path | TcpAddress) -> OpenPort:
        name = path.name if isinstance(path, Path) else str(path)
        set_to = self.instruments[name]
        scenario = ScenarioConfig()
        timeline, rng = running_timeline(), np.random.default_rng(1)
        station = SimulatedTotalStation(
            scenario.stations[0], scenario, scenario_world(scenario, 60.0, rng), timeline, rng
        )
        if set_to is None:
            station.switch_off()
        else:
            station.baud = set_to
        return SimulatedLine(station, timeline, VirtualClock(0), name=name).open

    def _run(self, arguments: Sequence[str]) -> Ran:
        match list(arguments):
            case ["systemctl", "is-active", unit]:
                return Ran(0 if unit in self.active else 3, "")
            case ["timedatectl", "show", *_]:
                return Ran(0, f"NTP={'yes' if self.ntp else 'no'}\n")
        command = " ".join(arguments)
        if command == self.interrupted_at:
            self.interrupted_at = ""
            raise KeyboardInterrupt
        self.commands.append(command)
        match list(arguments):
            case ["systemd-sysusers", "--inline", line]:
                self._sysusers(line)
            case ["systemd-sysusers", name]:
                for line in (self.root / "etc/sysusers.d" / name).read_text().splitlines():
                    self._sysusers(line)
            case ["systemctl", "enable", unit]:
                link = self.root / "etc/systemd/system/multi-user.target.wants" / unit
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(f"/etc/systemd/system/{unit}")
            case ["systemctl", "restart", unit] if unit.startswith("tsgt-"):
                self.active.add(unit)
            case ["timedatectl", "set-ntp", "false"]:
                self.ntp = False
            case ["dtparam", "spi=on"] if not self.spi_at_boot:
                self.boot()
        return Ran(0, "")

    def _sysusers(self, line: str) -> None:
        """Do what systemd-sysusers does with a line of sysusers.d(5)."""
        kind, *words = line.split() or ["#"]
        group_file, user_file = self.root / "etc/group", self.root / "etc/passwd"
        groups = [entry.split(":") for entry in group_file.read_text().splitlines()]
        names = {entry[0] for entry in groups}
        if kind in "ug" and words[0] not in names:
            groups.append([words[0], "x", str(900 + len(groups)), ""])
        if kind == "u" and not any(
            entry.startswith(f"{words[0]}:") for entry in user_file.read_text().splitlines()
        ):
            # The user who runs the test: nobody else's files can be made here.
            with user_file.open("a") as file:
                file.write(f"{words[0]}:x:{os.getuid()}:{os.getgid()}::/var/lib/tsgt:/usr/sbin/nologin\n")
        if kind == "m":
            entry = next(each for each in groups if each[0] == words[1])
            members = [each for each in entry[3].split(",") if each]
            if words[0] not in members:
                entry[3] = ",".join([*members, words[0]])
        group_file.write_text("".join(":".join(entry) + "\n" for entry in groups))
