"""The option ``--apply``: write a set-up file where the master reads it, and have the running master use it."""

from __future__ import annotations

import json
import os
import socket
import struct
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

import click

from tsgt.cli.options import path_type
from tsgt.config import MasterConfig, load, missing_setup_files, parameters
from tsgt.errors import TsgtError
from tsgt.master.reload import RELOAD_SIGNAL
from tsgt.recording import SETUP_START, SetupRecord, encode_line

if TYPE_CHECKING:
    from pathlib import Path

RESPONSE_TIMEOUT_S = 20.0
"""A master on a busy machine reads its files within a second."""

SetupFile = Literal["station_frames", "prism_layout"]

Calibrated = tuple[Any, Any]
"""Stations and prisms of a record ``setup``."""

apply_option = click.option(
    "--apply",
    "master",
    type=path_type,
    metavar="MASTER.TOML",
    help="Configuration of the master: write the set-up file that it names, and have the running master use it.",
)


def output_of(output: Path | None, master: Path | None, file: SetupFile) -> Path | None:
    """Return the file to write: the one that is given, or the one that the configuration of the master names."""
    if master is None:
        return output
    if output is not None:
        raise click.UsageError(
            "--output and --apply exclude each other: --apply writes the file of the master"
        )
    return getattr(load(master, MasterConfig).setup, file)  # type: ignore[no-any-return]


def apply_setup(master: Path) -> str:
    """Have the running master read its set-up files; return in a sentence what it has done.

    Raises TsgtError if the master rejects them, cannot be reached by this user, or does not respond.
    """
    config = load(master, MasterConfig)
    if missing := missing_setup_files(config):
        return f"no poses yet: {', '.join(map(str, missing))} does not exist"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stream:
        try:
            stream.connect(str(config.stream.socket))
        except OSError as error:
            if isinstance(error, PermissionError):
                raise TsgtError(f"{config.stream.socket}: {error.strerror}; try sudo") from error
            return "the master is not running; it uses the file from its next start on"
        size = struct.calcsize("3i")
        pid, _, _ = struct.unpack("3i", stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
        event, message, in_force = _response(stream, pid)
    if event != "setup_applied":
        raise TsgtError(f"the master has rejected the set-up: {message}")
    if in_force != _calibrated(encode_line(SetupRecord.of(parameters(config), 0))):
        raise TsgtError(
            f"the running master has read its files again, but its stations and prisms are not those of {master}, which was edited after "
            "its start: restart it (sudo systemctl restart tsgt-master)"
        )
    return f"the running master uses it: {message}"


def _response(stream: socket.socket, pid: int) -> tuple[str, str, Calibrated]:
    """Signal the master; return the event that says what it has done, its message, and the set-up that is in force then."""
    deadline_s = time.monotonic() + RESPONSE_TIMEOUT_S
    greeted = False
    in_force: Calibrated = None, None
    with stream.makefile("rb") as lines, suppress(TimeoutError):
        while (left_s := deadline_s - time.monotonic()) > 0:
            stream.settimeout(left_s)
            line = lines.readline()
            if not line:
                raise TsgtError("the master has ended")
            if not greeted:  # before, it may act on the signal without sending us the event
                greeted = True
                _signal(pid)
            if line.startswith(SETUP_START):
                in_force = _calibrated(line)
            if line.startswith(b'{"type":"event"'):
                record = json.loads(line)
                if record["event"] in {"setup_applied", "setup_rejected"}:
                    return record["event"], record["message"], in_force
    raise TsgtError(f"the master has not responded within {RESPONSE_TIMEOUT_S:g} s")


def _calibrated(setup_line: bytes) -> Calibrated:
    record = json.loads(setup_line)
    return record["stations"], record["prisms"]


def _signal(pid: int) -> None:
    try:
        os.kill(pid, RELOAD_SIGNAL)
    except PermissionError as error:
        raise TsgtError("this user may not signal the master: sudo systemctl reload tsgt-master") from error
