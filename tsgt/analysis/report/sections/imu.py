"""Report section on the robot's IMU: samples, biases, the gyro against the prisms, and the wheel odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.figures import curve, panels_height_mm, stroke
from tsgt.analysis.inertial_smoothing import DISPLACEMENT_REMEDY
from tsgt.analysis.report.page import ReportFigure, Section, Table, format_number
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.geometry.inertial import preintegrate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tsgt.analysis.figures import TimeAxis
    from tsgt.analysis.inertial_smoothing import ImuUse
    from tsgt.analysis.report.findings import Findings
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import WheelsFit

TITLE = "IMU of the robot"

INTERVAL_NS = 1_000_000_000  # Over which rotations are compared
MAX_REJECTED_SHARE = 0.1  # Of the time of wheel odometry, above which the report says what may be wrong
GAP = 1.5  # Durations of a sample; a longer interval lacks some


@dataclass(frozen=True, slots=True)
class _Biases:
    """Biases over time: of the gyro in deg/s, of the accelerometer in m/s^2, axis by axis, with one sigma."""

    stamp_ns: FloatArray  # (K,)
    values: FloatArray  # (K, 6)
    sigmas: FloatArray  # (K, 6)

    @classmethod
    def of(cls, imu: ImuUse, origin_ns: int) -> _Biases:
        knots = imu.fit.trajectory.knots
        scale = np.array([180 / np.pi] * 3 + [1.0] * 3)
        values = np.concatenate([knots.gyro_bias, knots.bias_or_acceleration], axis=1)
        variances = np.diagonal(imu.fit.trajectory.covariance, axis1=1, axis2=2)[:, 9:15]
        return cls(origin_ns + 1e9 * knots.time_s, scale * values, scale * np.sqrt(variances))


def imu_section(f: Findings, axis: TimeAxis) -> Section | None:
    """Return the section; None without an IMU."""
    if f.continuous is None or f.recording.parameters.imu is None:
        return None
    imu = f.continuous.imu
    if imu is None:
        return Section(TITLE, (f"The IMU was not used: {f.continuous.imu_problem}.",))
    numbers = imu_numbers(f)
    stations = f"station{'' if len(imu.stations) == 1 else 's'} {', '.join(map(str, imu.stations))}"
    text = [f"The poses rest on the IMU and on the measurements of {stations}."]
    if imu.unused:
        text.append(
            f"For {format_number(imu.unused_s)} s the IMU was not used: samples were missing or contradicted the measurements, or "
            "there were only a few measurements of one prism, which may be the wrong one. Poses there rest on the stations alone; "
            "without three of them they are invalid."
        )
    if np.isfinite(imu.displaced_from_s):
        text.append(
            f"From {format_number(imu.displaced_from_s)} s on a knock may have displaced the IMU on the robot, because of a shock or of "
            f"missing samples, which fewer than three stations do not show: {DISPLACEMENT_REMEDY}."
        )
    if np.isfinite(imu.moved_from_s):
        text.append(
            f"From {format_number(imu.moved_from_s)} s on measurements contradict the IMU: {imu.moved_remedy}."
        )
    innovation = numbers["rotation_innovation_deg"]
    if innovation is not None:
        text.append(
            f"Over one second, the rotation by the gyro differs from that of the prisms by {innovation['rms']:.3f} deg (rms); the "
            f"noise of the prisms explains {innovation['expected']:.3f} deg. Clearly more means a wrong mounting or latency."
        )
    biases = _Biases.of(imu, f.continuous.origin_ns)
    rows = [
        ("sample rate", f"{format_number(numbers['rate_hz'])} Hz"),
        ("samples", str(len(imu.samples))),
        ("gaps", f"{numbers['gaps']}, {format_number(numbers['missing_s'], 2)} s in total"),
        *([] if f.log.imu is None else [("saturated samples", str(f.log.imu.saturated))]),
        ("time without use", f"{format_number(imu.unused_s)} s"),
        ("bias of the gyro, x, y, z (deg/s)", _triple(numbers["gyro_bias_dps"])),
        ("one sigma of it", _triple(numbers["gyro_bias_sigma_dps"], 4)),
        ("bias of the accelerometer, x, y, z (m/s^2)", _triple(numbers["accelerometer_bias_mps2"])),
        ("one sigma of it", _triple(numbers["accelerometer_bias_sigma_mps2"], 4)),
    ]
    tables = [Table("Samples and biases", (), tuple(rows))]
    if imu.fit.wheels is not None:
        text.append(_wheels_text(numbers["odometry"]))
        tables.append(_wheels_table(numbers["odometry"], f))
    plot = ReportFigure(
        "imu_biases",
        "Biases of the IMU",
        "Biases of the gyro and of the accelerometer as estimated, about their medians, with bands of two standard deviations. "
        "They change slowly with temperature; a step is a knock, or something loose.",
        panels_height_mm(2),
        lambda figure: draw_biases(figure, biases, axis),
    )
    return Section(TITLE, tuple(text), tuple(tables), (plot,))


def _wheels_text(numbers: dict[str, Any]) -> str:
    text = (
        "The wheel odometry was used: the true speed was 1 + scale + slip times the measured one. "
        f"{format_number(100 * numbers['rejected'])} % of the time it contradicted IMU and prisms, and hardly counted."
    )
    if numbers["rejected"] > MAX_REJECTED_SHARE:
        text += " That is much: wheels spun or were lifted, or the point, direction, scale or latency of the odometry is wrong."
    return text


def _wheels_table(numbers: dict[str, Any], f: Findings) -> Table:
    log = f.log.odometry
    rows = [
        ("samples", str(numbers["samples"])),
        *([] if log is None else [("gaps", f"{log.gaps}, {log.lost} samples lost")]),
        ("time with samples", f"{format_number(100 * numbers['covered'])} %"),
        ("scale", f"{100 * numbers['scale']:+.2f} +/- {100 * numbers['scale_sigma']:.2f} %"),
        ("slip, root mean square", f"{format_number(100 * numbers['slip_rms'])} %"),
        ("slip, largest", f"{format_number(100 * numbers['slip_max'])} %"),
        ("rejected", f"{format_number(100 * numbers['rejected'])} %"),
    ]
    return Table("Wheel odometry", (), tuple(rows))


def imu_numbers(f: Findings) -> dict[str, Any]:
    """Return the numbers of the section for a recording whose IMU was used."""
    continuous = f.continuous
    assert continuous is not None  # noqa: S101 (the caller checks)
    imu = continuous.imu
    assert imu is not None  # noqa: S101 (likewise)
    samples = imu.samples
    between_s = np.diff(samples.end_s)
    missing = between_s > GAP * samples.duration_s[1:]
    biases = _Biases.of(imu, continuous.origin_ns)
    middle, sigma = np.median(biases.values, axis=0), np.median(biases.sigmas, axis=0)
    return {
        "rate_hz": float(1.0 / np.median(samples.duration_s)),
        "gaps": int(missing.sum()),
        "missing_s": float((between_s - samples.duration_s[1:])[missing].sum()),
        "saturated": None if f.log.imu is None else f.log.imu.saturated,
        "gyro_bias_dps": middle[:3].tolist(),
        "gyro_bias_sigma_dps": sigma[:3].tolist(),
        "accelerometer_bias_mps2": middle[3:].tolist(),
        "accelerometer_bias_sigma_mps2": sigma[3:].tolist(),
        **({} if imu.fit.wheels is None else {"odometry": odometry_numbers(imu, imu.fit.wheels)}),
        "rotation_innovation_deg": None if f.linear is None else rotation_innovation(continuous, f.linear),
    }


def odometry_numbers(imu: ImuUse, wheels: WheelsFit) -> dict[str, Any]:
    """Return the numbers of wheel odometry that was used; shares are of the time, scale and slip relative."""
    knots = imu.fit.trajectory.knots
    step_s = np.diff(knots.time_s)
    covered_s = step_s[wheels.covered].sum()
    slip = knots.wheels[:, 1]
    return {
        "samples": imu.odometry_samples,
        "covered": float(covered_s / step_s.sum()),
        "scale": float(np.median(knots.wheels[:, 0])),
        "scale_sigma": float(np.median(wheels.sigmas[:, 0])),
        "slip_rms": float(np.sqrt((slip**2).mean())),
        "slip_max": float(np.abs(slip).max()),
        "rejected": float(step_s[wheels.covered & wheels.rejected].sum() / max(covered_s, 1e-9)),
    }


def rotation_innovation(continuous: SmoothedRecording, linear: PoseBatch) -> dict[str, float] | None:
    """Compare rotations over one second by the gyro with those of the prisms alone, in deg rms, and what noise explains.

    ``linear``: poses that know nothing of the IMU. None: they have no two valid poses one second apart.
    """
    imu = continuous.imu
    assert imu is not None  # noqa: S101 (the caller checks)
    poses = linear.select(linear.valid)
    trajectory = imu.fit.trajectory
    later = np.searchsorted(poses.stamp_ns, poses.stamp_ns + INTERVAL_NS)
    first = np.flatnonzero(later < len(poses))
    first = first[poses.stamp_ns[later[first]] == poses.stamp_ns[first] + INTERVAL_NS]
    start_s = (poses.stamp_ns[first] - continuous.origin_ns) / 1e9
    bounds_s = trajectory.samples.bounds_s
    end_s = start_s + INTERVAL_NS / 1e9
    inside = (start_s >= bounds_s[0]) & (end_s <= bounds_s[-1])
    first, start_s, end_s = first[inside], start_s[inside], end_s[inside]
    if not len(first):
        return None
    rotation = rotation_from_quaternion(poses.orientation_xyzw)
    measured = np.swapaxes(rotation[first], 1, 2) @ rotation[later[first]]
    knots = trajectory.knots
    bias = knots.gyro_bias[np.clip(np.searchsorted(knots.time_s, start_s), 0, len(knots) - 1)]
    turned = preintegrate(trajectory.samples, start_s, end_s, bias, np.zeros(3)).rotation
    to_robot = trajectory.mounting.rotation
    # Poses may be those of a point with other axes.
    axes = rotation_from_quaternion(np.array(linear.reference_point.orientation_xyzw))
    by_gyro = axes.T @ to_robot @ turned @ to_robot.T @ axes
    error = log_so3(np.swapaxes(by_gyro, 1, 2) @ measured)
    variance = np.einsum("nii->n", poses.covariance[:, 3:, 3:])
    expected = variance[first] + variance[later[first]]
    return {
        "rms": float(np.degrees(np.sqrt((error**2).sum(axis=1).mean()))),
        "expected": float(np.degrees(np.sqrt(expected.mean()))),
    }


def draw_biases(figure: Figure, biases: _Biases, axis: TimeAxis) -> None:
    """Draw the biases of gyro and accelerometer with their bands."""
    panels = figure.subplots(2, 1, sharex=True)
    time = axis.of(biases.stamp_ns.astype(np.int64))
    for panel, first, label in ((panels[0], 0, "gyro\n(deg/s)"), (panels[1], 3, "accelerometer\n(m/s²)")):
        for row in range(3):
            values, sigmas = biases.values[:, first + row], biases.sigmas[:, first + row]
            centred = values - np.median(values)
            step = max(len(values) // 500, 1)
            panel.fill_between(
                time[::step],
                (centred - 2 * sigmas)[::step],
                (centred + 2 * sigmas)[::step],
                color=stroke(row).color,
                alpha=0.15,
                linewidth=0,
                label="band: 2 standard deviations" if first == row == 0 else None,
            )
            curve(panel, time, centred, row, label="xyz"[row] if first == 0 else None)
        panel.set_ylabel(label)
    panels[1].set_xlabel(axis.label)
    figure.align_ylabels(panels)
    figure.legend(loc="outside upper center", ncols=4)


def _triple(values: list[float], digits: int = 3) -> str:
    return ", ".join(format_number(value, digits) for value in values)
