"""Lines to instruments: the interface, the serial port (tty, pty, USB adapter), and the TCP connection.

In: a device path and a baud rate, or an address. Out: data chunks with arrival times. ``serial_port`` and ``tcp_port`` are
imported from their files and only where a real line is opened: the former needs pyserial, finds out which process holds a
port, and the USB adapter's latency. ``chunk_queue``, which needs asyncio, holds what a port has received.
"""

from tsgt.station.serial.base import Chunk, OpenPort, Port

__all__ = [
    "Chunk",
    "OpenPort",
    "Port",
]
