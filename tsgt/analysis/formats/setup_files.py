"""Writing set-up files (TOML): the results of a calibration, which ``tsgt.config`` reads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from tsgt.geometry import quaternion_from_rotation
from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.model import ImuParameters, SetupCovariance, TargetResidual


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentErrors:
    """Estimated instrument errors of a station, with the signs of ``StationParameters``; None: not estimated."""

    vertical_index_rad: float | None = None
    collimation_rad: float | None = None
    range_scale_ppm: float | None = None

    def table(self) -> dict[str, float]:
        """Return the keys of the set-up file."""
        values = {
            "vertical_index_mrad": None if self.vertical_index_rad is None else 1e3 * self.vertical_index_rad,
            "collimation_mrad": None if self.collimation_rad is None else 1e3 * self.collimation_rad,
            "range_scale_ppm": self.range_scale_ppm,
        }
        return {key: float(value) for key, value in values.items() if value is not None}


def write_station_frames(
    path: Path,
    frames: Mapping[int, FloatArray],
    rms_m: Mapping[int, float],
    *,
    comment: str,
    latencies_ms: Mapping[int, float] | None = None,
    targets: Mapping[int, Sequence[TargetResidual]] | None = None,
    instrument_errors: Mapping[int, InstrumentErrors] | None = None,
    covariance: SetupCovariance | None = None,
) -> None:
    """Write a file of kind ``station_frames``, atomically.

    Parameters
    ----------
    frames : (4, 4) ``T_station1_station`` in m by station number.
    rms_m : Root mean square of the target residuals against station 1, by number of the other stations.
    comment : Origin of the frames, written as one comment line at the top.
    latencies_ms : From the measurement to its timestamp by station number, if calibrated.
    targets : Target residuals by station number, if the frames come from targets.
    instrument_errors : By number of the stations for which they are estimated.
    covariance : Joint covariance of all these, if known.

    Raises
    ------
    OutputFileError : The file cannot be written.
    """
    tables = {}
    for station, T in sorted(frames.items()):
        table: dict[str, Any] = {"T_station1_station": T.tolist()}
        if station in rms_m:
            table["rms_mm"] = _to_mm(rms_m[station])
        if latencies_ms is not None and station in latencies_ms:
            table["latency_ms"] = round(float(latencies_ms[station]), 6)
        if instrument_errors is not None and station in instrument_errors:
            table |= instrument_errors[station].table()
        if targets is not None and targets.get(station):
            table["targets"] = [_target(target) for target in targets[station]]
        tables[str(station)] = table
    _write(path, {"kind": "station_frames", "stations": tables}, covariance, comment)


def write_prism_layout(
    path: Path,
    positions_m: Mapping[int, FloatArray],
    sigmas_m: Mapping[int, FloatArray],
    *,
    comment: str,
    covariance: SetupCovariance | None = None,
) -> None:
    """Write a file of kind ``prism_layout``, atomically, with a comment line at the top that states the origin.

    By prism number: (3,) position in the frame ``robot`` in m, and one sigma of each coordinate; ``covariance``: of all
    of them, if known. Raises OutputFileError if the file cannot be written.
    """
    tables = {
        str(prism): {"position_m": list(map(float, position)), "sigma_m": list(map(float, sigmas_m[prism]))}
        for prism, position in sorted(positions_m.items())
    }
    _write(path, {"kind": "prism_layout", "prisms": tables}, covariance, comment)


def write_imu_mounting(path: Path, imu: ImuParameters, *, comment: str, covariance: SetupCovariance) -> None:
    """Write a file of kind ``imu_mounting``, atomically, which describes the IMU completely. Raises OutputFileError if the file cannot be written."""
    content = {
        "kind": "imu_mounting",
        "position_m": list(imu.position_m),
        "orientation_xyzw": list(imu.orientation_xyzw),
        "latency_ms": imu.latency_ns / 1e6,
        "gyro_matrix": [list(row) for row in imu.gyro_matrix],
        "gravity_mps2": imu.gravity_mps2,
        "tilt_sigma_mrad": 1e3 * imu.tilt_sigma_rad,
        "noise": {
            "gyro_noise_density_radps_per_sqrt_hz": imu.noise.gyro_noise_density,
            "accelerometer_noise_density_mps2_per_sqrt_hz": imu.noise.accelerometer_noise_density,
            "gyro_bias_walk_radps_per_sqrt_s": imu.noise.gyro_bias_walk,
            "accelerometer_bias_walk_mps2_per_sqrt_s": imu.noise.accelerometer_bias_walk,
            "gyro_bias_radps": imu.noise.gyro_bias_radps,
            "accelerometer_bias_mps2": imu.noise.accelerometer_bias_mps2,
            "gyro_scale_misalignment": imu.noise.gyro_scale_misalignment,
            "accelerometer_scale_misalignment": imu.noise.accelerometer_scale_misalignment,
        },
    }
    _write(path, content, covariance, comment)


def write_sensor_mounting(
    path: Path,
    T_point_sensor: FloatArray,
    sigma: FloatArray,
    *,
    offset_s: float | None,
    offset_sigma_s: float,
    comment: str,
) -> None:
    """Write a file of kind ``sensor_mounting``, atomically. Raises OutputFileError if the file cannot be written.

    ``sigma``: (6,) of position and rotation in the axes of the point; NaN, as of the offset: unknown. ``offset_s`` None: it says nothing
    of other drives, and is not written.
    """
    content: dict[str, Any] = {
        "kind": "sensor_mounting",
        "position_m": [round(each, 7) for each in T_point_sensor[:3, 3].tolist()],
        "orientation_xyzw": quaternion_from_rotation(T_point_sensor[:3, :3]).tolist(),
    }
    sigmas = [("position_sigma_mm", 1e3 * sigma[:3]), ("rotation_sigma_deg", np.degrees(sigma[3:]))]
    if offset_s is not None:
        content["offset_ms"] = round(1e3 * offset_s, 6)
        sigmas.append(("offset_sigma_ms", np.array([1e3 * offset_sigma_s])))
    for key, part in sigmas:
        if np.isfinite(part).all():
            content[key] = part.tolist() if len(part) > 1 else float(part[0])
    _write(path, content, None, comment)


def _covariance_table(covariance: SetupCovariance) -> str:
    """Return the TOML table, one row of the matrix per line."""
    rows = "".join(f"    [{', '.join(map(repr, row))}],\n" for row in covariance.matrix)
    names = ", ".join(f'"{name}"' for name in covariance.components)
    return f"\n[covariance]\ncomponents = [{names}]\nmatrix = [\n{rows}]\n"


def _target(fit: TargetResidual) -> dict[str, Any]:
    lengths_m = {"residual_mm": fit.residual_m, "leave_one_out_mm": fit.leave_one_out_m}
    return {"target": fit.target} | {
        key: _to_mm(value) for key, value in lengths_m.items() if value is not None
    }


def _to_mm(length_m: float) -> float:
    """Convert to mm, rounded to the micrometre."""
    return round(1e3 * float(length_m), 3)


def _write(path: Path, content: Mapping[str, Any], covariance: SetupCovariance | None, comment: str) -> None:
    # A file name in the comment may contain a line break.
    printable = "".join(character if character.isprintable() else "?" for character in comment)
    with write_atomically(path) as file:
        table = "" if covariance is None else _covariance_table(covariance)
        file.write(f"# {printable}\n{tomli_w.dumps(content)}{table}".encode())
