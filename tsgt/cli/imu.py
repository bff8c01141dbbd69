"""The command group ``imu``: programs that read an IMU for the master."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from tsgt.imu.device import Device

baud_option = click.option(
    "--baud",
    type=click.IntRange(9_600, 921_600),
    default=115_200,
    help="Bit rate that the device uses already; it is not changed.",
)
rate_option = click.option(
    "--rate-hz", type=click.IntRange(1, 800), default=200, help="Samples per second to be set at the device."
)


@click.group()
def imu() -> None:
    """Read an IMU for the master.

    These programs set a device up and print its samples, as docs/reference/imu-program.md specifies. The master starts
    them: see [imu] in its configuration. Each ends when its standard input ends.
    """


@imu.command()
@click.argument("port")
@baud_option
@rate_option
def vectornav(*, port: str, baud: int, rate_hz: int) -> None:
    """Read a VectorNav VN-100.

    PORT is its serial port, such as /dev/serial/by-id/usb-... The rate must be a divisor of 800. The output settings
    are lost when the device is switched off.
    """
    from tsgt.imu.vectornav import VectorNav

    try:
        device = VectorNav(rate_hz)
    except ValueError as error:
        raise click.UsageError(f"--rate-hz: {error}") from error
    _run(device, port, baud, rate_hz)


@imu.command()
@click.argument("port")
@baud_option
@rate_option
def xsens(*, port: str, baud: int, rate_hz: int) -> None:
    """Read an Xsens (Movella) MTi, by messages MTData2.

    PORT is its serial port, such as /dev/serial/by-id/usb-... Rates are 100, 200 and 400 for most devices. The device
    keeps the setting of its output.
    """
    from tsgt.imu.xsens import Xsens

    _run(Xsens(rate_hz), port, baud, rate_hz)


def _run(device: Device, port: str, baud: int, rate_hz: int) -> None:
    from tsgt.imu.serial_program import Port, run

    def put(line: bytes) -> None:
        sys.stdout.buffer.write(line + b"\n")
        sys.stdout.buffer.flush()

    run(device, Port(port, baud), rate_hz, put)
