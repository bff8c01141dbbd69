"""A simulated total station behind a pseudo-terminal, in real time: to other programs it is a serial port.

A pseudo-terminal knows no speed; the pace is kept here. The speed that a program has set on its end counts: a wrong one
gives garbage, as on a real line.
"""

from __future__ import annotations

import asyncio
import os
import pty
import termios
import tty
from typing import TYPE_CHECKING, Self

from tsgt.simulation.instrument.serial_line import Wire
from tsgt.simulation.kernel import LoopTimeline

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
"""By the constants that terminals are set with."""


class PtyLine:
    """A cable with a pseudo-terminal at its near end; an async context manager.

    Parameters
    ----------
    instrument
        At the far end, on a :class:`~tsgt.simulation.kernel.timeline.LoopTimeline`.
    link
        Symbolic link that names the terminal; like the names in /dev/serial/by-id it stays the same.
    """

    def __init__(self, instrument: SimulatedTotalStation, link: Path) -> None:
        self._instrument = instrument
        self._link = link
        self._near: int | None = None
        self._far: int | None = None
        self._wire: Wire | None = None

    async def __aenter__(self) -> Self:
        """Plug in."""
        self._wire = Wire(self._instrument, LoopTimeline(asyncio.get_running_loop()), self._deliver)
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
        """What goes wrong with the instrument's answers."""
        assert self._wire is not None, "enter the line first"  # noqa: S101
        return self._wire.faults

    def plug(self) -> None:
        """Plug in; the terminal may be another one than before, the link names it."""
        assert self._wire is not None, "enter the line first"  # noqa: S101
        if self._far is not None:
            return
        # As long as one descriptor of the near end is open here, programs may close and open theirs as they like.
        self._far, self._near = pty.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self._wire.plugged = True
        beside = self._link.with_name(f".{self._link.name}.new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(os.ttyname(self._near))
        beside.replace(self._link)
        asyncio.get_running_loop().add_reader(self._far, self._read)

    def unplug(self) -> None:
        """Pull the cable: programs that have the terminal open get an error, and the link is gone."""
        if self._far is None or self._near is None or self._wire is None:
            return
        self._wire.plugged = False
        self._link.unlink(missing_ok=True)
        asyncio.get_running_loop().remove_reader(self._far)
        os.close(self._near)
        os.close(self._far)
        self._near = self._far = None

    def _read(self) -> None:
        assert self._far is not None  # noqa: S101 (it is the reader's)
        assert self._wire is not None  # noqa: S101
        try:
            data = os.read(self._far, _READ_SIZE)
        except OSError:
            return
        self._wire.host_baud = self._host_baud()
        self._wire.send(data)

    def _deliver(self, data: bytes) -> None:
        if self._far is None or self._wire is None:
            return
        try:
            os.write(self._far, data)
        except OSError:
            return  # nobody reads, and the terminal is full: a serial port loses bytes then too

    def _host_baud(self) -> int:
        assert self._near is not None  # noqa: S101 (it is open as long as the far end is)
        return _BAUDS.get(termios.tcgetattr(self._near)[5], 0) or 9600
