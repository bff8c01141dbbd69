"""The option ``--apply``: write a set-up file where the master reads it, and have the running master use it."""

from __future__ import annotations

import json
import os
import socket
import stat
import struct
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

import click

from tsgt.cli.options import path_type
from tsgt.config import MasterConfig, load, missing_setup_files, parameters, parameters_in_force
from tsgt.errors import ConfigError, OutputFileError, TsgtError
from tsgt.master.reload import RELOAD_SIGNAL, usable_setup
from tsgt.recording import SETUP_START, SetupRecord, encode_line, sync_folder

if TYPE_CHECKING:
    from collections.abc import Callable
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


def write_setup(output: Path, master: Path | None, file: SetupFile, write: Callable[[Path], None]) -> None:
    """Write a set-up file; ``write`` writes it to a path. That of a master keeps its owner and permissions.

    Raises TsgtError if the master could not use it, though it can use the one before, which then stays.
    """
    if master is None:
        write(output)
        return
    config = load(master, MasterConfig)
    target = output.resolve()
    new = target.with_name(f".{target.name}.new")
    try:
        write(new)
        problem = _problem(config.model_copy(update={"setup": config.setup.model_copy(update={file: new})}))
        if problem is not None and _problem(config) is None:
            raise TsgtError(
                f"{output} is not replaced, because the master could not use the new one: "
                f"{problem.replace(str(new), 'the new file')}; measure what is missing, or write it elsewhere with --output"
            )
        _share(new, target)
        new.replace(target)
        sync_folder(target)
    except OSError as error:
        raise OutputFileError(f"cannot be written ({error.strerror})", path=output) from error
    finally:
        new.unlink(missing_ok=True)


def _problem(config: MasterConfig) -> str | None:
    """Return why a master cannot use its set-up files; None: it can."""
    try:
        usable_setup(lambda: parameters_in_force(config))
    except ConfigError as error:
        return str(error)
    return None


def _share(new: Path, old: Path) -> None:
    """Give a file the owner and the permissions of the one that it replaces; without one the master, another user, may read it."""
    if not old.exists():
        new.chmod(0o644)
        return
    state = old.stat()
    new.chmod(stat.S_IMODE(state.st_mode))
    with suppress(PermissionError):  # only root may
        os.chown(new, state.st_uid, state.st_gid)


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
            if problem := _problem(config):
                raise TsgtError(
                    f"the file is written, but the master, which is not running, cannot use its set-up: {problem}"
                ) from error
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
