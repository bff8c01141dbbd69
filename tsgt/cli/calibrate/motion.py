"""The command ``tsgt calibrate motion``: set-up parameters from the motion of the robot."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.calibration import calibrate_recording
from tsgt.analysis.formats import InstrumentErrors, write_prism_layout, write_station_frames
from tsgt.analysis.validation import check_time_span, plausible_measurements
from tsgt.cli.model_options import add_options
from tsgt.cli.options import (
    FiniteRange,
    OutputFile,
    json_option,
    keep_going_option,
    recording_argument,
    refuse_given,
)
from tsgt.cli.output import (
    CHECK_FAILED,
    print_json,
    print_table,
    refuse_overwrite,
    report_problem,
    require_folder,
)
from tsgt.cli.recordings import calibrated
from tsgt.geometry.motion_calibration import SetupPrior, unobservable_directions
from tsgt.model import SetupCovariance
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.calibration import CalibratedRecording, HeldOutComparison
    from tsgt.analysis.evaluation import HeldOutErrors

UNKNOWN_SHIFT_M = 10.0
UNKNOWN_TURN_RAD = 0.2
UNKNOWN_LATENCY_S = 1.0
"""One sigma about an initial guess found from the motion alone, which is good to centimetres."""

_SIGMAS = {
    "--frame-sigma-mm": (20.0, "One sigma of the known frames at the robot, translation."),
    "--frame-sigma-mrad": (2.0, "One sigma of the known frames, rotation."),
    "--latency-sigma-ms": (100.0, "One sigma of the latencies."),
    "--prism-sigma-mm": (5.0, "One sigma of the prism positions."),
}


_OF_KNOWN_FRAMES = "frame_sigma_mm", "frame_sigma_mrad", "latency_sigma_ms"


@click.command()
@recording_argument
@click.option(
    "--initial-frames",
    "frames",
    type=click.Choice(["known", "unknown"]),
    default="known",
    help="Refine the recorded frames, or solve them from the motion alone.",
)
@click.option(
    "--dof",
    type=click.Choice(["6", "4"]),
    default="6",
    help="Degrees of freedom of a station; 4: heading and position of levelled stations.",
)
@click.option("--latency/--no-latency", default=True, help="Estimate latencies relative to station 1.")
@click.option("--estimate-prisms", is_flag=True, help="Estimate the prism positions as well.")
@add_options(
    *(
        click.option(name, type=FiniteRange(min=0, min_open=True, max=1e6), default=default, help=text)
        for name, (default, text) in _SIGMAS.items()
    )
)
@click.option(
    "--held-out/--no-held-out",
    default=True,
    help="Compute the held-out prediction error: five more calibrations, each without a fifth of the measurements.",
)
@click.option(
    "--output", type=OutputFile(".toml"), help="File of station frames and latencies to write (.toml)."
)
@click.option(
    "--prism-output", type=OutputFile(".toml"), help="Prism layout to write (.toml); with --estimate-prisms."
)
@keep_going_option
@json_option
def motion(
    *,
    recording: Path,
    frames: str,
    dof: str,
    latency: bool,
    estimate_prisms: bool,
    frame_sigma_mm: float,
    frame_sigma_mrad: float,
    latency_sigma_ms: float,
    prism_sigma_mm: float,
    held_out: bool,
    output: Path | None,
    prism_output: Path | None,
    keep_going: bool,
    as_json: bool,
) -> int:
    """Refine frames and latencies from motion.

    Wrong frames and latencies deform the rigid robot as it drives, so no targets are needed. Unobservable directions
    are named. Exit code 3: the held-out prediction error has grown; the files are written nevertheless.
    """
    for path in (output, prism_output):
        refuse_overwrite([recording], path)
        require_folder(path)
    if prism_output is not None and not estimate_prisms:
        raise click.UsageError("--prism-output needs --estimate-prisms; without it the layout is fixed")
    if output is not None and prism_output is not None and output.resolve() == prism_output.resolve():
        raise click.UsageError(
            "--output and --prism-output are the same file; the prisms would replace the frames"
        )
    known = frames == "known"
    if not known:
        refuse_given(*_OF_KNOWN_FRAMES, because="with --initial-frames unknown")
    if not latency:
        refuse_given("latency_sigma_ms", because="with --no-latency")
    if not estimate_prisms:
        refuse_given("prism_sigma_mm", because="without --estimate-prisms")
    loaded = load_recording(recording, keep_going=keep_going, on_problem=report_problem)
    loaded = calibrated(loaded, recording)
    check_time_span(loaded.parameters, plausible_measurements(loaded), recording)
    found = calibrate_recording(
        loaded,
        SetupPrior(
            translation_sigma_m=frame_sigma_mm / 1e3 if known else UNKNOWN_SHIFT_M,
            rotation_sigma_rad=frame_sigma_mrad / 1e3 if known else UNKNOWN_TURN_RAD,
            levelled=dof == "4",
            latency_sigma_s=(latency_sigma_ms / 1e3 if known else UNKNOWN_LATENCY_S) if latency else 0.0,
            prism_sigma_m=prism_sigma_mm / 1e3 if estimate_prisms else 0.0,
        ),
        frames_known=known,
        held_out=held_out,
        on_progress=_progress if sys.stderr.isatty() else None,
    )
    weak = unobservable_directions(found.calibration)
    stations = _stations(found)
    positions = {each.prism: np.array(each.position_m) for each in found.parameters.prisms}
    sigmas = dict(zip(positions, found.calibration.prism_sigmas_m(), strict=True))
    if as_json:
        print_json(_json(found, stations, weak, positions, sigmas))
    else:
        _print(found, stations, positions if estimate_prisms else {}, sigmas)
    for direction in weak:
        click.echo(f"note: unobservable from this motion (one sigma): {direction}", err=True)
    comment = f"written by tsgt calibrate motion {recording} --initial-frames {frames} --dof {dof}"
    if output is not None:
        write_station_frames(
            output,
            {each.station: np.array(each.T_station1_station) for each in found.parameters.stations},
            {},
            latencies_ms={each.station: each.latency_ns / 1e6 for each in found.parameters.stations},
            instrument_errors={
                each.station: InstrumentErrors(
                    vertical_index_rad=each.vertical_index_rad,
                    collimation_rad=each.collimation_rad,
                    range_scale_ppm=each.atmospheric_ppm or None,
                )
                for each in found.parameters.stations
                if each.vertical_index_rad or each.collimation_rad or each.atmospheric_ppm
            },
            covariance=_of_stations(found.parameters.setup_covariance),
            comment=comment,
        )
        for each in found.parameters.stations:
            if each.atmospheric_ppm:
                click.echo(
                    f"note: {output} has the scale of station {each.station}'s distances in this recording, "
                    f"{each.atmospheric_ppm:g} ppm; it replaces atmospheric_ppm of the configuration",
                    err=True,
                )
    if prism_output is not None:
        write_prism_layout(prism_output, positions, sigmas, comment=comment)
    judged = found.held_out
    if judged is not None and judged.grown:
        click.echo(
            "check failed: the held-out prediction error is larger than with the recorded set-up; keep the old set-up files "
            "and see docs/how-to/calibrate-from-motion.md",
            err=True,
        )
        return CHECK_FAILED
    if judged is not None and judged.before is not None and judged.grown is None:
        click.echo(
            "note: the calibration was not validated: no measurement could be held out and predicted",
            err=True,
        )
    return 0


def _of_stations(covariance: SetupCovariance | None) -> SetupCovariance | None:
    """Keep the components that a file of station frames has."""
    if covariance is None:
        return None
    kept = [i for i, name in enumerate(covariance.components) if name.startswith("station")]
    if not kept:
        return None
    return SetupCovariance(
        components=tuple(covariance.components[i] for i in kept),
        matrix=tuple(tuple(covariance.matrix[i][j] for j in kept) for i in kept),
    )


def _progress(step: str) -> None:
    click.echo(f"{step} ...", err=True)


def _stations(found: CalibratedRecording) -> dict[int, dict[str, Any]]:
    calibration = found.calibration
    unknowns = calibration.parameters
    shifts_m, turns_rad = calibration.corrections()
    sigmas = np.sqrt(np.diag(calibration.covariance))
    result = {}
    for place, row in enumerate(unknowns.stations):
        parameters = found.parameters.stations[row]
        late = sigmas[unknowns.latencies[place]]
        result[parameters.station] = {
            "correction_mm": 1e3 * float(np.linalg.norm(shifts_m[row])),
            "correction_mrad": 1e3 * float(np.linalg.norm(turns_rad[row])),
            "correction_xyz_mm": (1e3 * shifts_m[row]).tolist(),
            "correction_xyz_mrad": (1e3 * turns_rad[row]).tolist(),
            "sigma_mm": (1e3 * sigmas[unknowns.translations[place]]).tolist(),
            "sigma_mrad": (1e3 * sigmas[unknowns.rotations[place]]).tolist(),
            "latency_ms": parameters.latency_ns / 1e6,
            "latency_correction_ms": 1e3 * float(calibration.setup.latencies_s[row]),
            "latency_sigma_ms": 1e3 * float(late),
            "T_station1_station": [list(line) for line in parameters.T_station1_station],
        }
    return result


def _json(
    found: CalibratedRecording,
    stations: dict[int, dict[str, Any]],
    weak: list[str],
    positions: dict[int, Any],
    sigmas: dict[int, Any],
) -> dict[str, Any]:
    calibration, judged = found.calibration, found.held_out
    return {
        "stations": stations,
        "prisms": {prism: position.tolist() for prism, position in positions.items()},
        "prism_sigma_mm": {prism: (1e3 * sigma).tolist() for prism, sigma in sigmas.items()},
        "pivot_m": calibration.parameters.pivot.tolist(),
        "unobservable": weak,
        "measurements": calibration.measurements,
        "outliers": calibration.outliers,
        "noise_scale": calibration.noise_scale,
        "disagreement": calibration.birge_ratio,
        "wander_ms": 1e3 * calibration.wander_s,
        "motion": asdict(calibration.prior),
        "linear": None if judged is None else _figures(judged.linear),
        "grown": None if judged is None else judged.grown,
        "before": None if judged is None or judged.before is None else _figures(judged.before),
        "after": None if judged is None else _figures(judged.after),
    }


def _figures(predicted: HeldOutErrors) -> dict[str, Any]:
    return {**asdict(predicted.statistics), "gaps": asdict(predicted.gaps)}


def _print(
    found: CalibratedRecording,
    stations: dict[int, dict[str, Any]],
    positions: dict[int, Any],
    sigmas: dict[int, Any],
) -> None:
    calibration = found.calibration
    click.echo(
        f"{calibration.measurements} measurements, {calibration.outliers} outliers, "
        f"noise scale {calibration.noise_scale:.2f}; sigmas scaled by {calibration.birge_ratio:.2f} (Birge ratio of parts of the recording)"
    )
    if calibration.prior_sigmas[calibration.parameters.latencies].any():
        click.echo(f"wander of the timestamps of a station: {1e3 * calibration.wander_s:.2f} ms")
    rows = []
    for station, each in stations.items():
        for axis, name in enumerate("xyz"):
            rows.append(
                [
                    f"station {station} {name}",
                    f"{each['correction_xyz_mm'][axis]:.2f}",
                    f"{each['sigma_mm'][axis]:.2f}",
                    f"{each['correction_xyz_mrad'][axis]:.3f}",
                    f"{each['sigma_mrad'][axis]:.3f}",
                ]
            )
    print_table(["correction", "mm at the robot", "sigma", "mrad", "sigma"], rows)
    click.echo()
    latencies = [
        [
            f"station {station}",
            f"{each['latency_ms']:.2f}",
            f"{each['latency_correction_ms']:+.2f}",
            f"{each['latency_sigma_ms']:.2f}",
        ]
        for station, each in stations.items()
    ]
    print_table(["latency relative to station 1", "ms", "correction", "sigma"], latencies)
    if positions:
        click.echo()
        print_table(
            ["prism", "x m", "y m", "z m", "sigma mm x", "y", "z"],
            [
                [str(prism), *(f"{v:.4f}" for v in position), *(f"{1e3 * v:.2f}" for v in sigmas[prism])]
                for prism, position in positions.items()
            ],
        )
    if found.held_out is not None:
        click.echo()
        _print_judgement(found.held_out)


def _print_judgement(judged: HeldOutComparison) -> None:
    rows = []
    for name, predicted in (("linear", judged.linear), ("before", judged.before), ("after", judged.after)):
        if predicted is not None:
            figures, gaps = predicted.statistics, predicted.gaps
            numbers = (figures.mean, figures.median, figures.p95, gaps.mean)
            rows.append([name, *(f"{number:.2f}" for number in numbers)])
    title = f"prediction error of {judged.after.statistics.n} held-out measurements (mm)"
    print_table([title, "mean", "median", "p95", f"mean of {judged.after.gaps.n} in gaps"], rows)
