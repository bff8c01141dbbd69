"""The command ``status``: what runs on this computer and how well, readable on a small screen in the sun."""

from __future__ import annotations

import contextlib
import math
import socket
import textwrap
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt.cli.options import DEFAULT_CLIENT_SOCKET, DEFAULT_SOCKET, path_type
from tsgt.cli.output import CHECK_FAILED, harmless
from tsgt.cli.render import clock_time
from tsgt.errors import StreamError
from tsgt.model import Status
from tsgt.recording import MAX_LINE_BYTES, HelloRecord, StationStatus, StatusRecord, Typed, decode
from tsgt.station import ClientStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.recording.journal import InstrumentRecord

TIMEOUT_S = 5.0
"""A master sends a status each second; one that sends none for this long is stuck."""

LATE_S = 3.0
"""A station that was last heard, or measured, longer ago than this needs somebody to look."""

MASTER_LATE_S = 10.0
"""A master that synchronises with another station is silent here for a second or two."""

WIDTH = 40
"""Characters of the narrowest terminal that is used in the field."""

MASTER_NOT_HEARD = "MASTER NOT HEARD"

WORDS = {
    Status.OK: "TRACKING",
    Status.LOW_ACCURACY: "TRACKING",
    Status.ANGLE_ONLY: "NO DISTANCE",
    Status.NO_TARGET: "NO PRISM",
    Status.TILT: "NOT LEVEL",
    Status.WRONG_DISTANCE: "WRONG TARGET",
    Status.ERROR: "ERROR",
}
"""What an instrument's status is called where there is no room for a sentence."""


@click.command()
@click.option(
    "--socket",
    "socket_path",
    type=path_type,
    envvar="TSGT_SOCKET",
    show_envvar=True,
    help=f"Socket of a master or of a client.  [default: {DEFAULT_SOCKET}, else {DEFAULT_CLIENT_SOCKET}]",
)
@click.option("--json", "as_json", is_flag=True, help="Print the status record as it comes.")
def status(socket_path: Path | None, *, as_json: bool) -> int:
    """Tell how the daemon on this computer does: the master with all its stations, or a station's client.

    Exit code 1: none runs. 3: one runs, but something needs a person: a station that is not heard or does not track,
    no valid pose.
    """
    record, line = _ask(socket_path)
    if isinstance(record, ClientStatus):
        text, well = client_text(record)
    else:
        text, well = master_text(record)
    click.echo(line.rstrip() if as_json else "\n".join(text))
    return 0 if well else CHECK_FAILED


def master_text(record: StatusRecord) -> tuple[list[str], bool]:
    """Put a master's status into lines of at most 40 characters, and tell whether all is well."""
    valid = record.valid_poses > 0
    lines = [
        f"MASTER  {clock_time(record.stamp_ns)} UTC",
        f"poses {record.poses}, valid {record.valid_poses}",
    ]
    if record.frame_ms is not None:
        lines.append(f"frame {record.frame_ms:.0f} ms")
    if record.protocol == "superframe" and not record.authenticated:
        lines.append(_headline("NO KEY: anybody can take part", good=False))
    well = valid
    for station in record.stations:
        word, good = station_word(station)
        lines += ["", _headline(f"STATION {station.id}  {word}", good=good), *_station_lines(station)]
        well = well and good
    return lines, well


def station_word(station: StationStatus) -> tuple[str, bool]:
    """Say in a word or two how a station does, and whether that is well."""
    if station.last_heard_s is None:
        return "NOT HEARD YET", False
    if station.last_heard_s > LATE_S and not station.answering:
        return f"SILENT {duration(station.last_heard_s)}", False
    if station.status is None or station.age_s is None:
        return "NO MEASUREMENT YET", False
    if (
        station.status.usable and station.age_s - station.last_heard_s > LATE_S
    ):  # it answers, but always the same
        return f"OLD {duration(station.age_s)}", False
    return WORDS[station.status], station.status.usable


def _station_lines(station: StationStatus) -> list[str]:
    """Return some lines of figures, as far as they are known."""
    if station.last_heard_s is None:
        return ["  off, too far, or other key, protocol", "  or radio: `tsgt status` there tells"]
    lines = []
    prism = "" if station.prism is None else f"prism {station.prism}  "
    rate = "" if station.rate_hz is None else f"{station.rate_hz:.2f} Hz  "
    age = "" if station.age_s is None else f"last {duration(station.age_s)}"
    lines.append(f"  {prism}{rate}{age}".rstrip())
    loss = "" if station.loss is None else f"loss {100 * station.loss:.0f} %  "
    strength = "" if station.rssi_dbm is None else f"{station.rssi_dbm:.0f} dBm  "
    snr = "" if station.snr_db is None else f"SNR {station.snr_db:.0f}"
    lines.append(f"  {loss}{strength}{snr}".rstrip())
    if station.clock_bound_ns is not None:
        lines.append(f"  clock within {station.clock_bound_ns / 1e6:.2f} ms")
    elif station.stamp_bound_ns is not None:
        lines.append(f"  time within {station.stamp_bound_ns / 1e6:.2f} ms")
    counts = {
        "outstanding": station.outstanding,
        "missed slots": station.missed_slots,
        "rejected beacons": station.rejected_beacons,
    }
    lines += [f"  {count} {of_what}" for of_what, count in counts.items() if count]
    return [line for line in lines if line.strip()]


def client_text(record: ClientStatus) -> tuple[list[str], bool]:
    """Put a client's status into lines of at most 40 characters, and tell whether all is well."""
    problems = _client_problems(record)
    lines = [_headline(f"STATION {record.station}  {problems[0] if problems else 'OK'}", good=not problems)]
    lines += [_headline(problem, good=False) for problem in problems[1:]]
    lines += [_headline(part, good=False) for part in _wrapped(record.problem)]
    lines += ["", *_instrument_lines(record)]
    if record.mode == "direct":
        lines.append("direct: single measurements")
    elif record.instrument is not None:
        lines.append(f"tracking prism {record.prism}, {record.rate_hz:.2f} Hz")
    if not lines[-1].startswith(record.activity):  # an instrument that tracks says so itself
        lines += _wrapped(record.activity, "  ")
    if (last := record.last) is not None:
        distance = "no distance" if last.slope_distance_m is None else f"{last.slope_distance_m:.4f} m"
        lines += [
            f"last {duration(last.age_s)}: {WORDS[last.status]}",
            f"  hz {math.degrees(last.horizontal_angle_rad):.4f} v {math.degrees(last.zenith_angle_rad):.4f} deg",
            f"  {distance}",
        ]
    lines += ["", f"{record.measurements} measured, journal {'ok' if record.journal_ok else 'FAILS'}"]
    if record.journal_waiting:
        lines.append(f"  {record.journal_waiting} lines not written yet")
    if record.journal_lost:
        lines.append(f"  {record.journal_lost} lines lost")
    lines.append(f"  {harmless(Path(record.journal).name)}")
    if record.master_heard_s is None:
        lines.append("master not heard yet")
    else:
        lines.append(f"master heard {duration(record.master_heard_s)} ago")
        lines.append(f"  {record.rssi_dbm or 0:.0f} dBm  SNR {record.snr_db or 0:.0f}")
    if MASTER_NOT_HEARD in problems:
        lines += _why_not_heard(record)
    if record.protocol == "superframe":
        lines += _superframe_lines(record)
    return lines, not problems


def _instrument_lines(record: ClientStatus) -> list[str]:
    """Say which instrument it is, and what it adds to distances by itself."""
    lines = _wrapped(record.instrument or "no instrument")
    if record.battery_percent is not None:
        lines.append(f"  battery {record.battery_percent} %")
    if (settings := record.settings) is not None:
        lines += setting_lines(settings)
    return lines


def setting_lines(settings: InstrumentRecord) -> list[str]:
    """Say in lines of at most 40 characters what an instrument adds to a distance, as far as it is known."""
    lines = []
    if settings.prism_constant_m is not None:
        lines.append(f"  prism {harmless(settings.prism_type)} {1e3 * settings.prism_constant_m:+.1f} mm")
    if settings.atmospheric_ppm is not None:
        air = f"  air {settings.atmospheric_ppm:+.1f} ppm"
        if settings.temperature_c is not None and settings.pressure_hpa is not None:
            air += f": {settings.temperature_c:.1f} C, {settings.pressure_hpa:.1f} hPa"
        lines.append(air)
    return lines


def _wrapped(text: str, indent: str = "") -> list[str]:
    """Break a text from outside into lines that do not steer the terminal."""
    lines = textwrap.wrap(
        text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
    # Before it is styled: afterwards our own codes would be made harmless, too.
    return [harmless(line) for line in lines]


def _why_not_heard(record: ClientStatus) -> list[str]:
    """Say what the radio hears instead of the master, and what is to be compared with the master's configuration."""
    if record.refused and record.unknown_packets:
        return [f"  {record.refused} beacons refused: compare the keys"]
    if record.unknown_packets:
        return [f"  {record.unknown_packets} packets not understood:", "  compare protocols and keys"]
    return ["  nothing heard: master off, too far,", "  or other frequency, SF, bandwidth"]


def _superframe_lines(record: ClientStatus) -> list[str]:
    """Say how delivery and time of the protocol superframe do."""
    lines = [f"{record.queued} to deliver, {record.missed_slots} missed slots"]
    if record.clock_bound_ns is not None:
        lines.append(f"  clock within {record.clock_bound_ns / 1e6:.2f} ms")
    if record.rejected_beacons:
        lines.append(f"  {record.rejected_beacons} rejected beacons")
    if not record.authenticated:
        lines.append(_headline("NO KEY: anybody can take part", good=False))
    return lines


def _client_problems(record: ClientStatus) -> list[str]:
    """Say what needs a person, the most urgent first, in a few words each."""
    last = record.last
    problems = []
    if record.instrument is None:
        problems.append("NO INSTRUMENT")
    elif record.problem:
        problems.append("SEE TO THE INSTRUMENT")
    if record.instrument is not None and record.mode == "tracking":
        if last is None or (last.status.usable and last.age_s > LATE_S):
            problems.append("NO MEASUREMENT" if last is None else f"OLD {duration(last.age_s)}")
        elif not last.status.usable:
            problems.append(WORDS[last.status])
    if not record.journal_ok:
        problems.append("DISK FAILS")
    if not record.radio_ok:
        problems.append("NO RADIO")
    elif record.master_heard_s is None or record.master_heard_s > MASTER_LATE_S:
        problems.append(MASTER_NOT_HEARD)
    elif record.joined is False:
        problems.append("NOT JOINED")
    return problems


def duration(seconds: float) -> str:
    """Write a duration so that it takes little room: 0.4 s, 12 s, 3 min, 2 h."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"


def _headline(text: str, *, good: bool) -> str:
    """Write what needs a person so that it is seen; click leaves the codes out where there is no terminal."""
    return click.style(text, bold=True, reverse=not good)


def _ask(socket_path: Path | None) -> tuple[StatusRecord | ClientStatus, bytes]:
    """Ask at the socket given, else at where a master, then a client would be."""
    if socket_path is not None:
        return status_of(socket_path)
    try:
        return status_of(DEFAULT_SOCKET)
    except StreamError:
        with contextlib.suppress(StreamError):
            return status_of(DEFAULT_CLIENT_SOCKET)
    raise StreamError(
        f"nothing runs here: nobody serves {DEFAULT_SOCKET} or {DEFAULT_CLIENT_SOCKET}; "
        "start tsgt-master or tsgt-client, or give --socket"
    )


def status_of(path: Path) -> tuple[StatusRecord | ClientStatus, bytes]:
    """Wait for the first status line on a socket."""
    for line in _lines(path):
        try:
            match decode(Typed, line).type:
                case "status":
                    return decode(StatusRecord, line), line
                case "client_status":
                    return decode(ClientStatus, line), line
                case "hello":
                    decode(HelloRecord, line)
        except ValueError as error:
            raise StreamError(f"{path}: what it says is no stream of tsgt ({error})") from error
    raise StreamError(f"{path}: it ended without a status; is it a replay?")


def _lines(path: Path) -> Iterator[bytes]:
    deadline_s = time.monotonic() + TIMEOUT_S
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(TIMEOUT_S)
        received = b""
        try:
            connection.connect(str(path))
            while chunk := connection.recv(65536):
                *lines, received = (received + chunk).split(b"\n")
                yield from lines
                if len(received) > MAX_LINE_BYTES:
                    break
                # For the whole, or one that sends something else now and then would hold us for ever.
                if (left_s := deadline_s - time.monotonic()) <= 0:
                    raise TimeoutError
                connection.settimeout(left_s)
            else:
                return
        except TimeoutError as error:
            raise StreamError(
                f"{path}: no status within {TIMEOUT_S:g} s; the daemon is stuck, see its log"
            ) from error
        except OSError as error:
            raise StreamError(f"{path}: nobody answers ({error.strerror or error})") from error
    raise StreamError(
        f"{path}: what it says is no stream of tsgt: a line is longer than {MAX_LINE_BYTES} bytes"
    )
