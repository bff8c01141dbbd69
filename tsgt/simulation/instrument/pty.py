"""A simulated total station behind a pseudo-terminal, in real time: a serial port for other programs.

A pseudo-terminal has no bit rate, so the bytes are paced here. If the program sets another bit rate than the
instrument's, both ends receive garbage, as on a real line.
"""

from __future__ import annotations

import asyncio
import os
import pty
import termios
import tty
from typing import TYPE_CHECKING, Self

from tsgt.simulation.instrument.serial_line import Wire

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from tsgt.simulation.instrument.serial_line import LineFaults
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation

_READ_SIZE = 4096

_BAUDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600)
    if hasattr(termios, f"B{baud}")
}
"""Bit rates by their termios constants."""


class PtyLine:
    """A cable to a pseudo-terminal; an async context manager.

    ``link`` is a symbolic link to the terminal, stable like the names in /dev/serial/by-id.
    """

    def __init__(self, instrument: SimulatedTotalStation, link: Path) -> None:
        self._instrument = instrument
        self._link = link
        self._slave: int | None = None
        self._master: int | None = None
        self._wire: Wire | None = None

    async def __aenter__(self) -> Self:
        """Plug in."""
        self._wire = Wire(self._instrument, self._instrument.timeline, self._deliver)
        self.plug()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Unplug."""
        self.unplug()

    @property
    def faults(self) -> LineFaults:
        """Faults of the instrument's responses."""
        assert self._wire is not None, "enter the line first"  # noqa: S101
        return self._wire.faults

    def plug(self) -> None:
        """Plug in; the terminal device may change, the link does not."""
        assert self._wire is not None, "enter the line first"  # noqa: S101
        if self._master is not None:
            return
        # Keeping the slave open here lets programs close and reopen it.
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._wire.plugged = True
        temporary = self._link.with_name(f".{self._link.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(os.ttyname(self._slave))
        temporary.replace(self._link)
        asyncio.get_running_loop().add_reader(self._master, self._read)

    def unplug(self) -> None:
        """Unplug: reads and writes of the open terminal fail, and the link disappears."""
        if self._master is None or self._slave is None or self._wire is None:
            return
        self._wire.plugged = False
        self._link.unlink(missing_ok=True)
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._slave)
        os.close(self._master)
        self._slave = self._master = None

    def _read(self) -> None:
        assert self._master is not None  # noqa: S101 (only read while open)
        assert self._wire is not None  # noqa: S101
        try:
            data = os.read(self._master, _READ_SIZE)
        except OSError:
            return
        self._wire.host_baud = self._host_baud()
        self._wire.send(data)

    def _deliver(self, data: bytes) -> None:
        if self._master is None or self._wire is None:
            return
        try:
            os.write(self._master, data)
        except OSError:
            return  # the terminal's buffer is full: drop the bytes, as a serial port does

    def _host_baud(self) -> int:
        assert self._slave is not None  # noqa: S101 (open whenever the master is)
        return _BAUDS.get(termios.tcgetattr(self._slave)[5], 0) or 9600
