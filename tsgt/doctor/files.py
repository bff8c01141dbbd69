"""Checks of files: configuration, key, set-up files, and the disk of journals and recordings."""

from __future__ import annotations

import errno
import math
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from tsgt.config import (
    ClientConfig,
    ImuMountingFile,
    MasterConfig,
    PrismLayoutFile,
    StationFramesFile,
    SuperframeConfig,
    check_permissions,
    load,
    load_any,
    missing_setup_files,
    parameters,
)
from tsgt.doctor.computer import EARLIEST, hides, is_installed, may_write
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.errors import ConfigError, GeometryError
from tsgt.radio.from_config import lora_settings
from tsgt.radio.key_file import check_access, read_key

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from tsgt.config import ProtocolConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

Daemon = ClientConfig | MasterConfig

BYTES_PER_HOUR = {"client": 22_000_000, "master": 145_000_000}  # At 20 Hz; 3 stations at 2.5 Hz, 20 poses/s
MIN_HOURS = 12  # A day in the field
SLOW_FSYNC_NS = 1_000_000_000  # A slower disk loses more than the second that a power cut may cost
_FSYNC_BYTES = 65_536
_FSYNCS = 5

MAX_FRAMES_AGE_NS = 12 * 3600 * 1_000_000_000  # Older ones are of another set-up, unless tripods stayed
VOLATILE = {"tmpfs", "ramfs", "overlay"}  # File systems that lose their changes at a power cut


def check_configuration(path: Path) -> tuple[Finding, Daemon | None]:
    """Check that a daemon accepts the configuration, and return it."""
    try:
        check_permissions(path)
        content = load_any(path)
        if not isinstance(content, ClientConfig | MasterConfig):
            return failed("configuration", f"{path}: not the configuration of a client or a master"), None
        lora_settings(content.radio, path)
    except ConfigError as error:
        hint = ""
        with suppress(OSError):
            if not path.exists():
                hint = "; copy an example from configs/, or give another file: tsgt doctor FILE"
        return failed("configuration", f"{error}{hint}"), None
    match content:
        case ClientConfig():
            who = f"client of station {content.station}, prism {content.prism}, instrument {content.instrument.kind}"
        case MasterConfig():
            who = f"master of stations {', '.join(str(each.station) for each in content.stations)}"
    return ok("configuration", f"{path}: {who}; protocol {content.protocol.kind}"), content


def check_key(machine: Machine, protocol: ProtocolConfig, user: User) -> Finding:
    """Check that the daemon can use the key."""
    if not isinstance(protocol, SuperframeConfig):
        return skipped("key", f"the protocol {protocol.kind} has no key")
    path = protocol.key_file
    if path is None:
        return note(
            "key",
            "no key is configured, so anybody with such a radio can take part: `tsgt radio key mission.key` makes one "
            "for all radios of the mission",
        )
    try:
        check_access(path, path.stat(), user.uid)
    except FileNotFoundError:
        return failed(
            "key",
            f"{path}: no such file; copy the key of the mission, or make one with `tsgt radio key {path}`",
        )
    except PermissionError:
        return skipped("key", f"{path}: the user {machine.user.name} may not access it: sudo tsgt doctor")
    except ConfigError as error:
        return failed("key", str(error))
    if machine.user.uid not in (0, user.uid):
        return ok("key", f"{path}: belongs to the user {user.name} only; sudo tsgt doctor checks its content")
    try:
        read_key(path, owner=user.uid)
    except ConfigError as error:
        return failed("key", str(error))
    return ok("key", f"{path}: a key, readable by the user {user.name} only")


def check_setup(machine: Machine, config: MasterConfig) -> list[Finding]:
    """Check that the set-up files fit the stations, and report origin, age and quality."""
    problem: ConfigError | None = None
    try:
        _check_layout(config)
    except ConfigError as error:
        problem = error
    files = dict(zip(_SETUP_FILES, config.setup_files, strict=False))  # the last one only if it is configured
    found = []
    if missing := missing_setup_files(config):
        problem = None
    if problem is not None and problem.path not in files.values():
        found.append(failed("stations", str(problem)))
    for name, path in files.items():
        if path in missing:
            text = f"{path} does not exist: the master runs without poses until `{_SETUP_FILES[name].command} ... --apply` writes it"
            found.append(note(name, text))
        elif problem is not None and problem.path == path:
            found.append(failed(name, str(problem)))
        else:
            found.append(_check_setup_file(machine, name, path))
    return found


def _check_layout(config: MasterConfig) -> None:
    """Raise ConfigError with the path of the invalid file."""
    # Imported here, as a client has no scipy.
    import numpy as np  # noqa: PLC0415

    from tsgt.geometry import check_layout  # noqa: PLC0415

    prisms = parameters(config).prisms
    try:
        check_layout(
            np.array([prism.position_m for prism in prisms]).reshape(-1, 3),
            names=[each.prism for each in prisms],
            imu=config.imu is not None,
        )
    except GeometryError as error:
        path = config.setup.prism_layout
        raise ConfigError(f"{path}: prisms: {error}", path=path, key="prisms") from error


def _check_setup_file(machine: Machine, name: str, path: Path) -> Finding:
    try:
        check_permissions(path)
        quality = _SETUP_FILES[name].quality(path)
        head = path.read_text(encoding="utf-8").partition("\n")[0]
        written_ns = path.stat().st_mtime_ns
    except ConfigError as error:
        return failed(name, str(error))
    if "written by tsgt calibrate" not in head:
        return note(
            name, f"{path}: not written by `{_SETUP_FILES[name].command}`; is it the example? {quality}"
        )
    now_ns = machine.clock.realtime_ns()
    if now_ns < EARLIEST.timestamp() * 1e9 or written_ns > now_ns:
        return note(name, f"{path}: {quality}; its age is unknown, as this clock is wrong")
    age_ns = now_ns - written_ns
    text = f"{path}: {quality}; written {_age(age_ns)} ago"
    if name == "station_frames" and age_ns > MAX_FRAMES_AGE_NS:
        return note(
            name,
            f"{text}: if a tripod has moved since, measure the targets again; `tsgt calibrate check` detects that",
        )
    return ok(name, text)


def _frames_quality(path: Path) -> str:
    stations = load(path, StationFramesFile).stations
    residuals = {number: frame.rms_mm for number, frame in stations.items() if frame.rms_mm is not None}
    text = f"stations {', '.join(sorted(stations, key=int))}"
    if not residuals:
        return text
    worst = max(residuals, key=lambda number: residuals[number])
    return f"{text}, target residuals up to {residuals[worst]:.1f} mm rms (station {worst})"


def _layout_quality(path: Path) -> str:
    prisms = load(path, PrismLayoutFile).prisms
    sigmas_m = [max(entry.sigma_m) for entry in prisms.values() if entry.sigma_m is not None]
    text = f"prisms {', '.join(sorted(prisms, key=int))}"
    return f"{text}, one sigma up to {1e3 * max(sigmas_m):.1f} mm" if sigmas_m else text


def _mounting_quality(path: Path) -> str:
    covariance = load(path, ImuMountingFile).covariance
    text = "mounting of the IMU"
    if covariance is None:
        return f"{text}, its uncertainty is unknown"
    sigmas = {
        name: math.sqrt(covariance.matrix[i][i])
        for i, name in enumerate(covariance.components)
        if covariance.matrix[i][i] > 0
    }
    position_m = max((sigmas.get(f"imu.{axis}", 0.0) for axis in "xyz"), default=0.0)
    rotation_rad = max((sigmas.get(f"imu.rotation_{axis}", 0.0) for axis in "xyz"), default=0.0)
    return f"{text}, one sigma up to {1e3 * position_m:.1f} mm and {math.degrees(rotation_rad):.2f} deg"


class _SetupFile(NamedTuple):
    command: str
    """The command that writes it."""
    quality: Callable[[Path], str]
    """Reads it and says how good it is."""


_SETUP_FILES = {
    "station_frames": _SetupFile("tsgt calibrate targets", _frames_quality),
    "prism_layout": _SetupFile("tsgt calibrate prisms", _layout_quality),
    "imu_mounting": _SetupFile("tsgt calibrate imu", _mounting_quality),
}
"""In the order of ``MasterConfig.setup_files``."""


def _age(age_ns: int) -> str:
    hours = age_ns / 3.6e12
    if hours < 1:
        return f"{60 * hours:.0f} min"
    return f"{hours:.0f} h" if hours < 48 else f"{hours / 24:.0f} days"


def check_disk(
    machine: Machine, config: Daemon, user: User, service: Mapping[str, str] | None
) -> list[Finding]:
    """Check that the daemon's user can write to a persistent, large and fast folder for journals or recordings.

    ``service``: properties of the daemon's unit, which creates the folder.
    """
    folder = (config.journal if isinstance(config, ClientConfig) else config.recording).directory
    existing = _existing_parent(folder)
    if hides(service, folder):
        return [
            failed(
                "disk",
                f"the sandbox of the service hides {folder}: configure a folder outside of /home, /root and /run/user, "
                "as /var/lib/tsgt",
            ),
            skipped("disk_write", "the service may not write to it"),
        ]
    if not may_write(service, folder):
        return [
            failed(
                "disk",
                f"the sandbox of the service excludes {folder}: sudo systemctl edit tsgt-{config.kind}, "
                f"and add, under [Service]: ReadWritePaths={folder}",
            ),
            skipped("disk_write", "the service may not write to it"),
        ]
    if existing != folder and not is_installed(service) and not user.may_use(existing):
        return [
            failed(
                "disk",
                f"{folder} does not exist and the user {user.name} may not create it: "
                f"sudo install -d -o {user.name} -m 750 {folder}",
            ),
            skipped("disk_write", "the folder does not exist"),
        ]
    if existing == folder and not user.may_use(folder):
        return [
            failed(
                "disk", f"the user {user.name} may not write to {folder}: sudo chown -R {user.name} {folder}"
            ),
            skipped("disk_write", "the user of the daemon may not write to it"),
        ]
    return [
        _check_space(machine, folder, existing, config.kind),
        _check_writing(machine, folder)
        if existing == folder
        else skipped("disk_write", f"{folder} does not exist yet; the daemon creates it"),
    ]


def _check_space(machine: Machine, folder: Path, existing: Path, kind: str) -> Finding:
    hours = machine.free_bytes(existing) / BYTES_PER_HOUR[kind]
    if (system := _file_system(machine, existing)) in VOLATILE:
        return failed(
            "disk",
            f"{folder} is in memory ({system}): everything written is lost at a power cut. Use another folder, or "
            "disable the overlay: sudo raspi-config nonint do_overlayfs 1, and reboot",
        )
    if hours < MIN_HOURS:
        return failed(
            "disk", f"{folder}: space for {hours:.1f} hours; move old files elsewhere (ls {folder})"
        )
    return ok("disk", f"{folder}: space for {min(hours, 9999):.0f} hours")


def _check_writing(machine: Machine, folder: Path) -> Finding:
    max_ns = 0
    try:
        with tempfile.TemporaryFile(dir=folder, prefix=".doctor-") as file:
            for _ in range(_FSYNCS):
                started_ns = machine.clock.monotonic_ns()
                file.write(bytes(_FSYNC_BYTES))
                file.flush()
                os.fsync(file.fileno())
                max_ns = max(max_ns, machine.clock.monotonic_ns() - started_ns)
    except PermissionError:
        return skipped("disk_write", f"the user {machine.user.name} may not write to it: sudo tsgt doctor")
    except OSError as error:
        if error.errno == errno.EROFS:
            return failed(
                "disk_write",
                f"{folder} is read-only: sudo mount -o remount,rw /; if that fails, the card is worn out",
            )
        return failed("disk_write", f"{folder} cannot be written ({error.strerror}): df -h {folder}")
    if max_ns > SLOW_FSYNC_NS:
        return note(
            "disk_write",
            f"{folder}: fsync of {_FSYNC_BYTES // 1024} kB took {max_ns / 1e9:.1f} s, which a power cut may lose: use a better "
            "card, and keep a spare one",
        )
    return ok("disk_write", f"{folder}: fsync takes at most {max_ns / 1e6:.0f} ms")


def _existing_parent(folder: Path) -> Path:
    return next((path for path in (folder, *folder.absolute().parents) if path.is_dir()), Path("/"))


def _file_system(machine: Machine, folder: Path) -> str:
    """Return the type of the file system of a folder; empty if unknown."""
    kinds: dict[Path, str] = {}
    for line in (machine.read(machine.proc / "mounts") or "").splitlines():
        fields = line.split()
        if len(fields) >= 3:
            kinds[Path(fields[1].replace("\\040", " "))] = fields[2]
    resolved = folder.resolve()
    return next((kinds[path] for path in (resolved, *resolved.parents) if path in kinds), "")
