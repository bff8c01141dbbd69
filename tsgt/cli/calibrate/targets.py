"""The command ``tsgt calibrate targets``: station frames from common targets."""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.calibration import (
    TargetCalibration,
    solve_stations,
    suspect_exclusions,
    target_notes,
    target_residuals,
    unidentified_text,
)
from tsgt.analysis.formats import read_target_file, write_station_frames
from tsgt.cli.calibrate.apply import apply_option, apply_setup, output_of, write_setup
from tsgt.cli.calibrate.frame_output import (
    TARGET_CONSTANT,
    file_argument,
    frame_json,
    given,
    output_option,
    print_frame,
    target_constant_option,
    weak_text,
)
from tsgt.cli.options import FiniteRange, constant_m, json_option
from tsgt.cli.output import CHECK_FAILED, print_json, print_table, refuse_overwrite
from tsgt.config import (
    MasterConfig,
    StationCalibration,
    load,
    load_station_calibration,
    with_latencies,
)
from tsgt.errors import ConfigError
from tsgt.geometry.target_calibration import InstrumentError

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.calibration import Exclusion
    from tsgt.geometry.target_calibration import Check, FitQuality

_UNITS = {
    InstrumentError.VERTICAL_INDEX: ("vertical_index_mrad", 1e3),
    InstrumentError.COLLIMATION: ("collimation_mrad", 1e3),
    InstrumentError.RANGE_SCALE: ("range_scale_ppm", 1e6),
    InstrumentError.RANGE_CONSTANT: ("range_constant_mm", 1e3),
}


class _Exclusions(click.ParamType[tuple["Exclusion", ...]]):
    """Targets and sights to leave out: ``3,7,2:5``."""

    name = "targets"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Exclusion, ...]:
        """Return pairs of station (None: all) and target."""
        found: list[Exclusion] = []
        for part in str(value).split(","):
            station, colon, target = part.strip().rpartition(":")
            if not target.isdecimal() or (colon and not station.isdecimal()):
                self.fail(
                    f"{part!r} is neither a target, such as 3, nor station:target, such as 2:3", param, ctx
                )
            found.append((int(station) if colon else None, int(target)))
        return tuple(found)


@click.command()
@file_argument
@target_constant_option
@click.option(
    "--weights",
    type=click.Choice(["model", "none"]),
    default="model",
    help="Weight targets by the noise of both instruments, or equally (the paper's method). The checks are the same.",
)
@click.option("--levelled", is_flag=True, help="Solve heading and position only: all stations are levelled.")
@click.option(
    "--exclude",
    type=_Exclusions(),
    help="Targets to leave out, as 3,7; 2:3 leaves out target 3 of station 2 only.",
)
@click.option(
    "--max-residual-mm",
    type=FiniteRange(min=0, min_open=True, max=1e6),
    help="Leave out targets, the worst first, until no residual is larger, and accept the rest.",
)
@output_option
@apply_option
@json_option
def targets(
    *,
    file: Path,
    target_constant_mm: float | None,
    weights: str,
    levelled: bool,
    exclude: tuple[Exclusion, ...] | None,
    max_residual_mm: float | None,
    output: Path | None,
    master: Path | None,
    as_json: bool,
) -> int:
    """Solve station frames from common targets.

    FILE is a CSV of targets or the authors' marker file. All stations are solved together, with those errors of the
    instruments that the targets show. Exit code 3: a check failed. Inconsistent targets are not written; the message
    says which option leaves them out.
    """
    output = output_of(output, master, "station_frames")
    refuse_overwrite([file], output)
    measured = read_target_file(file)
    sights = (sight for seen in measured.measurements.values() for each in seen.values() for sight in each)
    solved = solve_stations(
        measured,
        target_constant_m=constant_m(TARGET_CONSTANT, target_constant_mm, sights, file),
        weighted=weights == "model",
        levelled=levelled,
        exclude=exclude or (),
        max_residual_m=None if max_residual_mm is None else max_residual_mm / 1e3,
    )
    notes = [*measured.skipped, *target_notes(solved)]
    options = given(TARGET_CONSTANT, target_constant_mm)
    options += f" --weights {weights}{' --levelled' if levelled else ''}"
    command = f"tsgt calibrate targets {shlex.quote(str(file))}{options}"
    excluded = _exclusions_text(exclude or ())
    options += f" --exclude {excluded}" if excluded else ""
    options += given("--max-residual-mm", max_residual_mm)
    if output is not None and solved.consistent:
        before = StationCalibration({}) if master is None else _before(output)
        comment = f"written by tsgt calibrate targets {file}{options}"
        notes += _write(output, master, solved, before, comment=comment)
        notes += _scale_notes(output, solved)
    if master is not None and solved.consistent:
        notes += _uncorrected_notes(file, master, solved)
    destination = f" --output {shlex.quote(str(output))}" if output is not None else ""
    if master is not None:
        destination = f" --apply {shlex.quote(str(master))}"
    failures = _failures(solved, command, excluded, destination)
    written = _written(solved, output)
    if as_json:
        print_json(_json(solved, notes, written, output))
    else:
        _print(solved)
        click.echo(written)
    for sentence in notes:
        click.echo(f"note: {sentence}", err=True)
    if master is not None and solved.consistent:
        click.echo(apply_setup(master), err=True)
    for sentence in failures:
        click.echo(f"check failed: {sentence}", err=True)
    return CHECK_FAILED if failures else 0


def _before(output: Path) -> StationCalibration:
    """Return the calibration that the set-up file of a master has; none if there is no such file, or it is invalid."""
    try:
        return load_station_calibration(output)
    except ConfigError:
        return StationCalibration({})


def _write(
    output: Path, master: Path | None, solved: TargetCalibration, before: StationCalibration, *, comment: str
) -> list[str]:
    """Write the set-up file, with the latencies of the one before: targets do not tell them. Return notes."""
    frames = {1: np.eye(4)} | {station: frame.T for station, frame in solved.frames.items()}
    latencies_ms = {
        number: setup.latency_ns / 1e6
        for number, setup in before.stations.items()
        if setup.latency_ns is not None and number in frames
    }

    def write(path: Path) -> None:
        write_station_frames(
            path,
            frames,
            {station: frame.rms_m for station, frame in solved.frames.items()},
            comment=comment,
            latencies_ms=latencies_ms,
            targets={station: target_residuals(frame) for station, frame in solved.frames.items()},
            instrument_errors=solved.instrument_errors(),
            covariance=with_latencies(solved.covariance, before.covariance, latencies_ms),
        )

    write_setup(output, master, "station_frames", write)
    return [
        f"{output} keeps the latency of station {number}, {value_ms:.3g} ms, which targets do not tell"
        for number, value_ms in sorted(latencies_ms.items())
    ]


def _scale_notes(output: Path, solved: TargetCalibration) -> list[str]:
    return [
        f"{output} has the scale of station {station}'s distances, {errors.range_scale_ppm:.3g} ppm; it replaces "
        "atmospheric_ppm of the configuration"
        for station, errors in solved.instrument_errors().items()
        if errors.range_scale_ppm is not None
    ]


def _uncorrected_notes(file: Path, master: Path, solved: TargetCalibration) -> list[str]:
    """Name the stations whose prism distances the master corrects for the air, where those of the targets were not."""
    errors = solved.instrument_errors()
    return [
        f"station {each.station}: {master} has atmospheric_ppm = {each.atmospheric_ppm:g}, but {file} has no such correction of "
        "its distances, so frames and poses differ in scale; add the column atmospheric_ppm, or set the instrument"
        for each in load(master, MasterConfig).stations
        if each.atmospheric_ppm and solved.atmospheric_ppm.get(each.station) == 0.0
        if each.station not in errors or errors[each.station].range_scale_ppm is None
    ]


def _written(solved: TargetCalibration, output: Path | None) -> str:
    """Return what was written to which file, or why nothing."""
    if output is None:
        return "nothing is written: no --output"
    if not solved.consistent:
        return f"{output} is not written: the targets are inconsistent"
    stations = ", ".join(map(str, (1, *solved.frames)))
    errors = ", instrument errors" if solved.instrument_errors() else ""
    return f"{output}: frames of stations {stations}{errors}, target residuals and joint covariance written"


def _exclusions_text(exclude: tuple[Exclusion, ...]) -> str:
    return ",".join(f"{target}" if station is None else f"{station}:{target}" for station, target in exclude)


def _failures(solved: TargetCalibration, command: str, excluded: str, destination: str) -> list[str]:
    """Return one sentence per failed check, with value and limit; a last one says how to go on if nothing is written."""
    sentences = []
    for check in solved.checks:
        if check.ok:
            continue
        if check.name == "unidentified_causes":
            sentences.append(
                f"the cause of the misfit is not identified: {unidentified_text(solved)}; measure these targets again, if "
                "possible in both faces"
            )
        elif check.name == "rotation_sigma_mrad":
            assert check.station is not None  # noqa: S101 (one per station)
            weak = solved.frames[check.station].weak
            sentences.append(weak_text(f"station {check.station}", "target", weak[0], check.limit))
        elif check.name == "tilt_mrad":
            sentences.append(
                f"station {check.station}: not level with station 1, the targets show {check.value:.2f} mrad between the "
                "vertical axes; solve without --levelled, or level both and measure again"
            )
        elif check.name == "tripod_moved":
            sentences.append(
                f"station {check.station}: the tripod moved while targets were measured, see the note"
            )
        else:
            whose = "all stations" if check.station is None else f"station {check.station}"
            sentences.append(
                f"{whose}: the targets are inconsistent: {check.name.replace('_', ' ')} {check.value:.2f}, limit {check.limit:.2f}"
            )
    if not solved.consistent:
        sentences.append(_way_on(solved, command, excluded, destination))
    return sentences


def _way_on(solved: TargetCalibration, command: str, excluded: str, destination: str) -> str:
    if suspects := suspect_exclusions(solved):
        left_out = ",".join(filter(None, (excluded, *suspects)))
        return f"measure the suspect targets again, or leave them out: {command} --exclude {left_out}{destination}"
    largest_mm = math.ceil(1e3 * max(frame.max_m for frame in solved.frames.values()))
    return (
        "measure again, or check constants and levelling; to accept the residuals as they are: "
        f"{command}{f' --exclude {excluded}' if excluded else ''} --max-residual-mm {largest_mm}{destination}"
    )


def _json(solved: TargetCalibration, notes: list[str], written: str, output: Path | None) -> dict[str, Any]:
    network = solved.network
    by_station = dict(zip(network.readings.stations, network.by_station, strict=True))
    return {
        "stations": {
            station: {
                "T_station1_station": frame.T.tolist(),
                **frame_json(frame),
                **_quality_json(by_station[station]),
            }
            for station, frame in solved.frames.items()
        },
        "overall": {
            **_quality_json(network.overall),
            "sigma_scale": network.scale,
            "along_noise_scale": network.by_component[0].noise_scale,
            "horizontal_noise_scale": network.by_component[1].noise_scale,
            "vertical_noise_scale": network.by_component[2].noise_scale,
        },
        "station1": _quality_json(by_station[1]),
        "instrument_errors": {
            station: {
                _UNITS[error][0]: {
                    "value": _UNITS[error][1] * estimate.value,
                    "sigma": _UNITS[error][1] * estimate.sigma,
                }
                for error, estimate in solved.errors(station).items()
            }
            for station in network.readings.stations
        },
        "checks": [_check_json(check) for check in solved.checks],
        "suspects": suspect_exclusions(solved),
        "notes": notes,
        "covariance": {
            "components": list(solved.covariance.components),
            "matrix": [list(row) for row in solved.covariance.matrix],
        },
        "written": {
            "path": str(output) if output is not None and solved.consistent else None,
            "text": written,
        },
    }


def _quality_json(quality: FitQuality) -> dict[str, float]:
    return {
        "chi_squared": quality.chi_squared,
        "degrees_of_freedom": quality.redundancy,
        "p_value": quality.p_value,
        "noise_scale": quality.noise_scale,
    }


def _check_json(check: Check) -> dict[str, Any]:
    name = check.name if check.station is None else f"station {check.station} {check.name}"
    return {"name": name, "value": check.value, "limit": check.limit, "ok": check.ok}


def _print(solved: TargetCalibration) -> None:
    network = solved.network
    by_station = dict(zip(network.readings.stations, network.by_station, strict=True))
    for station, frame in solved.frames.items():
        print_frame(f"station {station}", "target", frame)
        x, y, z, roll, pitch, yaw = 1e3 * np.sqrt(np.diag(frame.covariance))
        click.echo(
            f"one sigma: x {x:.2f}, y {y:.2f}, z {z:.2f} mm, "
            f"rotation about x {roll:.3f}, y {pitch:.3f}, z {yaw:.3f} mrad\n"
        )
    qualities = [
        ("all", network.overall),
        *((f"station {station}", each) for station, each in by_station.items()),
    ]
    print_table(
        ["fit", "chi-square", "degrees of freedom", "p", "noise scale"],
        [
            [
                name,
                f"{quality.chi_squared:.1f}",
                f"{quality.redundancy:.1f}",
                f"{quality.p_value:.2g}",
                f"{quality.noise_scale:.2f}",
            ]
            for name, quality in qualities
        ],
    )
    if network.scale > 1:
        click.echo(f"the sigmas above are scaled by the misfit: {network.scale:.2f}")
    rows = [
        [
            f"station {station} {_UNITS[error][0]}",
            f"{_UNITS[error][1] * estimate.value:.3f}",
            f"{_UNITS[error][1] * estimate.sigma:.3f}",
        ]
        for station in network.readings.stations
        for error, estimate in solved.errors(station).items()
    ]
    click.echo()
    print_table(["instrument error", "value", "sigma"], rows)
    click.echo()
    print_table(
        ["check", "value", "limit", ""],
        [
            [
                str(each["name"]),
                f"{each['value']:.3f}",
                f"{each['limit']:.3f}",
                "" if each["ok"] else "failed",
            ]
            for each in map(_check_json, solved.checks)
        ],
    )
