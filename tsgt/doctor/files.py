"""Checks of files: the configuration, the key, the set-up of the day, and the disk that everything goes to."""

from __future__ import annotations

import errno
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import (
    ClientConfig,
    MasterConfig,
    PrismLayoutFile,
    StationFramesFile,
    SuperframeConfig,
    check_trust,
    load,
    load_any,
    parameters,
)
from tsgt.doctor.computer import EARLIEST, is_installed, may_write
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.errors import ConfigError, GeometryError
from tsgt.radio.from_config import lora_settings
from tsgt.radio.key_file import check_access, read_key

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.config import ProtocolConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

Daemon = ClientConfig | MasterConfig

BYTES_PER_HOUR = {"client": 22_000_000, "master": 145_000_000}
"""A journal at 20 Hz; a recording of three stations at 2.5 Hz with 20 poses per second."""

ENOUGH_H = 12
"""A day in the field."""

SLOW_FSYNC_NS = 1_000_000_000
"""A disk that takes longer costs more than the second that a power cut may cost."""

_FSYNC_BYTES = 65_536
_FSYNCS = 5

OLD_FRAMES_NS = 12 * 3600 * 1_000_000_000
"""Station frames of another day are those of another set-up, unless the tripods have stayed."""

VOLATILE = {"tmpfs", "ramfs", "overlay"}
"""File systems that are gone, or as before, when the power is."""


def check_configuration(path: Path) -> tuple[Finding, Daemon | None]:
    """Tell whether a daemon takes this configuration, and return it."""
    try:
        check_trust(path)
        content = load_any(path)
        if not isinstance(content, ClientConfig | MasterConfig):
            return failed("configuration", f"{path}: is not the configuration of a client or a master"), None
        lora_settings(content.radio, path)
    except ConfigError as error:
        hint = ""
        with suppress(OSError):
            if not path.exists():
                hint = "; copy an example of configs/ to there, or name another file: tsgt doctor FILE"
        return failed("configuration", f"{error}{hint}"), None
    match content:
        case ClientConfig():
            who = f"client of station {content.station}, prism {content.prism}, instrument {content.instrument.kind}"
        case MasterConfig():
            who = f"master of stations {', '.join(str(each.station) for each in content.stations)}"
    return ok("configuration", f"{path}: {who}; protocol {content.protocol.kind}"), content


def check_key(machine: Machine, protocol: ProtocolConfig, user: User) -> Finding:
    """Tell whether there is a key that the daemon can use."""
    if not isinstance(protocol, SuperframeConfig):
        return skipped("key", f"the protocol {protocol.kind} has none")
    path = protocol.key_file
    if path is None:
        return note(
            "key",
            "there is none, so that anybody with such a radio can take part: `tsgt radio key mission.key` makes one "
            "for all radios of the mission",
        )
    try:
        check_access(path, path.stat(), user.uid)
    except FileNotFoundError:
        return failed(
            "key",
            f"{path}: no such file; copy the key of the mission to there, or make one by `tsgt radio key {path}`",
        )
    except PermissionError:
        return skipped("key", f"{path}: you, {machine.user.name}, may not look at it: sudo tsgt doctor")
    except ConfigError as error:
        return failed("key", str(error))
    if machine.user.uid not in (0, user.uid):
        return ok(
            "key",
            f"{path}: belongs to the user {user.name} alone; what is in it only sudo tsgt doctor can tell",
        )
    try:
        read_key(path, owner=user.uid)
    except ConfigError as error:
        return failed("key", str(error))
    return ok("key", f"{path}: a key, of the user {user.name} alone")


def check_setup(machine: Machine, config: MasterConfig) -> list[Finding]:
    """Tell whether the set-up files fit the stations, who wrote them, when, and how good they are."""
    problem: ConfigError | None = None
    try:
        _check_layout(config)
    except ConfigError as error:
        problem = error
    files = {"station_frames": config.setup.station_frames, "prism_layout": config.setup.prism_layout}
    found = []
    for name, path in files.items():
        if problem is not None and problem.path == path:
            found.append(failed(name, str(problem)))
        else:
            found.append(_judge_setup(machine, name, path))
    return found


def _check_layout(config: MasterConfig) -> None:
    """Raise ConfigError with the path of the file that cannot be used."""
    # Only here, as a client has no scipy.
    import numpy as np  # noqa: PLC0415

    from tsgt.geometry import check_layout  # noqa: PLC0415

    prisms = parameters(config).prisms
    try:
        check_layout(
            np.array([prism.position_m for prism in prisms]).reshape(-1, 3),
            names=[each.prism for each in prisms],
        )
    except GeometryError as error:
        path = config.setup.prism_layout
        raise ConfigError(f"{path}: prisms: {error}", path=path, key="prisms") from error


def _judge_setup(machine: Machine, name: str, path: Path) -> Finding:
    try:
        check_trust(path)
        quality = _frames_quality(path) if name == "station_frames" else _layout_quality(path)
        head = path.read_text(encoding="utf-8").partition("\n")[0]
        written_ns = path.stat().st_mtime_ns
    except ConfigError as error:
        return failed(name, str(error))
    command = "tsgt calibrate targets" if name == "station_frames" else "tsgt calibrate prisms"
    if "written by tsgt calibrate" not in head:
        return note(name, f"{path}: not written by `{command}`; is it the example? {quality}")
    now_ns = machine.clock.realtime_ns()
    if now_ns < EARLIEST.timestamp() * 1e9 or written_ns > now_ns:
        return note(name, f"{path}: {quality}; its age is not known, as this clock is not right")
    age_ns = now_ns - written_ns
    text = f"{path}: {quality}; written {_age(age_ns)} ago"
    if name == "station_frames" and age_ns > OLD_FRAMES_NS:
        return note(
            name,
            f"{text}: if any tripod has been moved since, measure the targets anew; `tsgt calibrate check` tells",
        )
    return ok(name, text)


def _frames_quality(path: Path) -> str:
    stations = load(path, StationFramesFile).stations
    residuals = {number: frame.rms_mm for number, frame in stations.items() if frame.rms_mm is not None}
    text = f"stations {', '.join(sorted(stations, key=int))}"
    if not residuals:
        return text
    worst = max(residuals, key=lambda number: residuals[number])
    return f"{text}, targets missed by {residuals[worst]:.1f} mm at worst (station {worst}, root mean square)"


def _layout_quality(path: Path) -> str:
    prisms = load(path, PrismLayoutFile).prisms
    sigmas_m = [max(entry.sigma_m) for entry in prisms.values() if entry.sigma_m is not None]
    text = f"prisms {', '.join(sorted(prisms, key=int))}"
    return f"{text}, known to {1e3 * max(sigmas_m):.1f} mm (one sigma)" if sigmas_m else text


def _age(age_ns: int) -> str:
    hours = age_ns / 3.6e12
    if hours < 1:
        return f"{60 * hours:.0f} min"
    return f"{hours:.0f} h" if hours < 48 else f"{hours / 24:.0f} days"


def check_disk(
    machine: Machine, config: Daemon, user: User, service: Mapping[str, str] | None
) -> list[Finding]:
    """Tell whether the folder that everything is written to stays, has room, and is quick enough.

    Parameters
    ----------
    machine
        Where it is.
    config
        Names the folder.
    user
        Who is to write there.
    service
        What systemd knows of the daemon's unit: with one it makes the folder.
    """
    folder = (config.journal if isinstance(config, ClientConfig) else config.recording).directory
    there = _first_that_exists(folder)
    if not may_write(service, folder):
        return [
            failed(
                "disk",
                f"the service is not let into {folder}, whatever its rights are: sudo systemctl edit tsgt-{config.kind}, "
                f"and there, under [Service]: ReadWritePaths={folder}",
            ),
            skipped("disk_write", "the service may not write there"),
        ]
    if there != folder and not is_installed(service) and not user.may_use(there):
        return [
            failed(
                "disk",
                f"{folder} is not there and the user {user.name} may not make it: "
                f"sudo install -d -o {user.name} -m 750 {folder}",
            ),
            skipped("disk_write", "there is no folder"),
        ]
    if there == folder and not user.may_use(folder):
        return [
            failed(
                "disk",
                f"the user {user.name} may not write into {folder}: sudo chown -R {user.name} {folder}",
            ),
            skipped("disk_write", "who runs the daemon may not write there"),
        ]
    return [
        _judge_room(machine, folder, there, config.kind),
        _judge_writing(machine, folder)
        if there == folder
        else skipped("disk_write", f"{folder} is not there yet; it is made when the daemon starts"),
    ]


def _judge_room(machine: Machine, folder: Path, there: Path, kind: str) -> Finding:
    hours = machine.free_bytes(there) / BYTES_PER_HOUR[kind]
    if (system := _file_system(machine, there)) in VOLATILE:
        return failed(
            "disk",
            f"{folder} lies in memory ({system}): all that is written is gone with the power. Name another folder, or "
            "switch the overlay off: sudo raspi-config nonint do_overlayfs 1, and reboot",
        )
    if hours < ENOUGH_H:
        return failed(
            "disk",
            f"{folder}: room for {hours:.1f} hours; copy old files to elsewhere and remove them (ls {folder})",
        )
    return ok("disk", f"{folder}: room for {min(hours, 9999):.0f} hours")


def _judge_writing(machine: Machine, folder: Path) -> Finding:
    longest_ns = 0
    try:
        with tempfile.TemporaryFile(dir=folder, prefix=".doctor-") as file:
            for _ in range(_FSYNCS):
                started_ns = machine.clock.monotonic_ns()
                file.write(bytes(_FSYNC_BYTES))
                file.flush()
                os.fsync(file.fileno())
                longest_ns = max(longest_ns, machine.clock.monotonic_ns() - started_ns)
    except PermissionError:
        return skipped(
            "disk_write", f"you, {machine.user.name}, may not write there: sudo tsgt doctor tries it"
        )
    except OSError as error:
        if error.errno == errno.EROFS:
            return failed(
                "disk_write",
                f"{folder} can only be read: sudo mount -o remount,rw /; where that fails the card is worn out",
            )
        return failed("disk_write", f"{folder} cannot be written ({error.strerror}): df -h {folder}")
    if longest_ns > SLOW_FSYNC_NS:
        return note(
            "disk_write",
            f"{folder}: the disk took {longest_ns / 1e9:.1f} s for {_FSYNC_BYTES // 1024} kB, so that a power cut costs "
            "as much: take a better card, and keep one in reserve",
        )
    return ok(
        "disk_write", f"{folder}: what is written is on the disk after {longest_ns / 1e6:.0f} ms at worst"
    )


def _first_that_exists(folder: Path) -> Path:
    return next((path for path in (folder, *folder.absolute().parents) if path.is_dir()), Path("/"))


def _file_system(machine: Machine, folder: Path) -> str:
    """Return the kind of the file system that a folder lies on; empty where the kernel does not say."""
    kinds: dict[Path, str] = {}
    for line in (machine.read(machine.proc / "mounts") or "").splitlines():
        fields = line.split()
        if len(fields) >= 3:
            kinds[Path(fields[1].replace("\\040", " "))] = fields[2]
    resolved = folder.resolve()
    return next((kinds[path] for path in (resolved, *resolved.parents) if path in kinds), "")
