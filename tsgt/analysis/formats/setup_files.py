"""Writing set-up files (TOML): the results of a calibration, which ``tsgt.config`` reads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import tomli_w

from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.model import TargetResidual


def write_station_frames(
    path: Path,
    frames: Mapping[int, FloatArray],
    rms_m: Mapping[int, float],
    *,
    comment: str,
    latencies_ms: Mapping[int, float] | None = None,
    targets: Mapping[int, Sequence[TargetResidual]] | None = None,
) -> None:
    """Write a file of kind ``station_frames``, atomically.

    Parameters
    ----------
    frames : (4, 4) ``T_station1_station`` in m by station number.
    rms_m : Root mean square of the target residuals against station 1, by number of the other stations.
    comment : Origin of the frames, written as one comment line at the top.
    latencies_ms : From the measurement to its timestamp by station number, if calibrated.
    targets : Target residuals by station number, if the frames come from targets.

    Raises
    ------
    OutputFileError : The file cannot be written.
    """
    tables = {}
    for station, T in sorted(frames.items()):
        table: dict[str, Any] = {"T_station1_station": T.tolist()}
        if station in rms_m:
            table["rms_mm"] = _to_mm(rms_m[station])
        if latencies_ms is not None:
            table["latency_ms"] = round(float(latencies_ms[station]), 6)
        if targets is not None and targets.get(station):
            table["targets"] = [_target(target) for target in targets[station]]
        tables[str(station)] = table
    _write(path, {"kind": "station_frames", "stations": tables}, comment)


def write_prism_layout(
    path: Path, positions_m: Mapping[int, FloatArray], sigmas_m: Mapping[int, FloatArray], *, comment: str
) -> None:
    """Write a file of kind ``prism_layout``, atomically, with a comment line at the top that states the origin.

    By prism number: (3,) position in the frame ``robot`` in m, and one sigma of each coordinate. Raises OutputFileError if
    the file cannot be written.
    """
    tables = {
        str(prism): {"position_m": list(map(float, position)), "sigma_m": list(map(float, sigmas_m[prism]))}
        for prism, position in sorted(positions_m.items())
    }
    _write(path, {"kind": "prism_layout", "prisms": tables}, comment)


def _target(fit: TargetResidual) -> dict[str, Any]:
    lengths_m = {"residual_mm": fit.residual_m, "leave_one_out_mm": fit.leave_one_out_m}
    return {"target": fit.target} | {
        key: _to_mm(value) for key, value in lengths_m.items() if value is not None
    }


def _to_mm(length_m: float) -> float:
    """Convert to mm, rounded to the micrometre."""
    return round(1e3 * float(length_m), 3)


def _write(path: Path, content: Mapping[str, Any], comment: str) -> None:
    # A file name in the comment may contain a line break.
    printable = "".join(character if character.isprintable() else "?" for character in comment)
    with write_atomically(path) as file:
        file.write(f"# {printable}\n{tomli_w.dumps(content)}".encode())
