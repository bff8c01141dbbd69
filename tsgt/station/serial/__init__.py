"""Serial ports of instruments: the interface, and the real port on tty, pty or USB adapter.

In: a device path and a baud rate. Out: data chunks with arrival times. ``serial_port`` is imported from its file and only
where a real port is opened: it needs pyserial. It also finds out which process holds a port, and the USB adapter's latency.
"""

from tsgt.station.serial.base import Chunk, OpenPort, Port

__all__ = [
    "Chunk",
    "OpenPort",
    "Port",
]
