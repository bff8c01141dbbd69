"""The command ``tsgt calibrate motion``: set-up from the motion of the robot."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

import click
import numpy as np

from tsgt.analysis.calibration import calibrate_recording
from tsgt.analysis.formats import write_prism_layout, write_station_frames
from tsgt.cli.options import json_option, keep_going_option, path_type, recording_argument
from tsgt.cli.output import CHECK_FAILED, print_json, print_table
from tsgt.cli.recordings import refuse_to_replace, report_problem
from tsgt.geometry.calibration import SetupPrior, unobservable_directions
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.analysis.calibration import CalibratedRecording, HeldOutComparison
    from tsgt.analysis.evaluation import HeldOutErrors
    from tsgt.geometry.calibration import UnobservableDirection

Command = TypeVar("Command", bound="Callable[..., Any] | click.Command")

UNKNOWN_SHIFT_M = 10.0
UNKNOWN_TURN_RAD = 0.2
UNKNOWN_LATENCY_S = 1.0
"""One sigma of what is found from the motion alone, about a first guess that is good to centimetres."""


def _sigma_option(name: str, default: float, text: str) -> Callable[[Command], Command]:
    return click.option(
        name,
        type=click.FloatRange(min=0, min_open=True, max=1e6),
        default=default,
        show_default=True,
        help=text,
    )


@click.command()
@recording_argument
@click.option(
    "--initial-frames",
    "frames",
    type=click.Choice(["known", "unknown"]),
    default="known",
    show_default=True,
    help="Refine the recording's frames, or find them from nothing but the motion.",
)
@click.option(
    "--dof",
    type=click.Choice(["6", "4"]),
    default="6",
    show_default=True,
    help="Degrees of freedom of a station; 4: all stations are level, only heading and position change.",
)
@click.option(
    "--latency/--no-latency", default=True, show_default=True, help="Find latencies beside station 1's."
)
@click.option("--prisms", is_flag=True, help="Find how the prisms sit to each other on the robot, too.")
@_sigma_option("--frame-sigma-mm", 20.0, "How well known frames are known at the robot, one sigma.")
@_sigma_option("--frame-sigma-mrad", 2.0, "The same for how a station is turned.")
@_sigma_option("--latency-sigma-ms", 100.0, "The same for latencies.")
@_sigma_option("--prism-sigma-mm", 5.0, "The same for prisms.")
@click.option(
    "--held-out/--no-held-out",
    default=True,
    show_default=True,
    help="Judge it by calibrating five times more, each without a fifth of the measurements.",
)
@click.option(
    "--output", type=path_type, help="File of station frames and latencies to write, for the configuration."
)
@click.option("--prism-output", type=path_type, help="Prism layout file to write; with --prisms.")
@keep_going_option
@json_option
def motion(
    *,
    recording: Path,
    frames: str,
    dof: str,
    latency: bool,
    prisms: bool,
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
    """Refine frames and latencies from the motion in RECORDING, or find them from nothing else.

    Wrong ones bend the rigid robot as it drives. No targets are needed. What the motion did not determine is named. Exit
    code 3: measurements that were left out are predicted worse than before; the files are written all the same.
    """
    refuse_to_replace([recording], output)
    refuse_to_replace([recording], prism_output)
    if prism_output is not None and not prisms:
        raise click.UsageError("--prism-output needs --prisms: the layout is held otherwise")
    known = frames == "known"
    found = calibrate_recording(
        load_recording(recording, keep_going=keep_going, on_problem=report_problem),
        SetupPrior(
            translation_sigma_m=frame_sigma_mm / 1e3 if known else UNKNOWN_SHIFT_M,
            rotation_sigma_rad=frame_sigma_mrad / 1e3 if known else UNKNOWN_TURN_RAD,
            levelled=dof == "4",
            latency_sigma_s=(latency_sigma_ms / 1e3 if known else UNKNOWN_LATENCY_S) if latency else 0.0,
            prism_sigma_m=prism_sigma_mm / 1e3 if prisms else 0.0,
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
        _print(found, stations, positions if prisms else {}, sigmas)
    for direction in weak:
        click.echo(f"note: the motion did not determine (one sigma): {direction.sentence}", err=True)
    comment = f"written by tsgt calibrate motion {recording} --initial-frames {frames} --dof {dof}"
    if output is not None:
        write_station_frames(
            output,
            {each.station: np.array(each.T_station1_station) for each in found.parameters.stations},
            {},
            latencies_ms={each.station: each.latency_ns / 1e6 for each in found.parameters.stations},
            comment=comment,
        )
    if prism_output is not None:
        write_prism_layout(prism_output, positions, sigmas, comment=comment)
    judged = found.judgement
    if judged is None or judged.before is None or judged.after.statistics.mean <= judged.before.statistics.mean:
        return 0
    click.echo("check failed: measurements that were left out are predicted worse than before", err=True)
    return CHECK_FAILED


def _progress(words: str) -> None:
    click.echo(f"{words} ...", err=True)


def _stations(found: CalibratedRecording) -> dict[int, dict[str, Any]]:
    calibration = found.calibration
    unknowns = calibration.unknowns
    shifts_m, turns_rad = calibration.corrections()
    sigmas = np.sqrt(np.diag(calibration.covariance))
    result = {}
    for place, row in enumerate(unknowns.stations):
        parameters = found.parameters.stations[row]
        late = sigmas[unknowns.latencies[place]] if len(unknowns.latencies) else 0.0
        turn_sigmas = np.zeros(3)
        turn_sigmas[3 - unknowns.rotations.shape[1] :] = sigmas[unknowns.rotations[place]]
        result[parameters.station] = {
            "correction_mm": 1e3 * float(np.linalg.norm(shifts_m[row])),
            "correction_mrad": 1e3 * float(np.linalg.norm(turns_rad[row])),
            "correction_xyz_mm": (1e3 * shifts_m[row]).tolist(),
            "correction_xyz_mrad": (1e3 * turns_rad[row]).tolist(),
            "sigma_mm": (1e3 * sigmas[unknowns.translations[place]]).tolist(),
            "sigma_mrad": (1e3 * turn_sigmas).tolist(),
            "latency_ms": parameters.latency_ns / 1e6,
            "latency_correction_ms": 1e3 * float(calibration.setup.latencies_s[row]),
            "latency_sigma_ms": 1e3 * float(late),
            "T_station1_station": [list(line) for line in parameters.T_station1_station],
        }
    return result


def _json(
    found: CalibratedRecording,
    stations: dict[int, dict[str, Any]],
    weak: list[UnobservableDirection],
    positions: dict[int, Any],
    sigmas: dict[int, Any],
) -> dict[str, Any]:
    calibration, judged = found.calibration, found.judgement
    return {
        "stations": stations,
        "prisms": {prism: position.tolist() for prism, position in positions.items()},
        "prism_sigma_mm": {prism: (1e3 * sigma).tolist() for prism, sigma in sigmas.items()},
        "pivot_m": calibration.unknowns.pivot.tolist(),
        "unobservable": [direction.description for direction in weak],
        "measurements": calibration.measurements,
        "outliers": calibration.outliers,
        "noise_scale": calibration.noise_scale,
        "disagreement": calibration.birge_ratio,
        "wander_ms": 1e3 * calibration.wander_s,
        "motion": asdict(calibration.prior),
        "linear": None if judged is None else _figures(judged.linear),
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
        f"noise {calibration.noise_scale:.2f} times the stated one; sigmas times {calibration.disagreement:.2f}, "
        "as parts of the recording contradict each other"
    )
    if len(calibration.unknowns.latencies):
        click.echo(f"time stamps of a station wander by {1e3 * calibration.wander_s:.2f} ms")
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
    print_table(["corrected by", "mm at the robot", "sigma", "mrad", "sigma"], rows)
    click.echo()
    late = [
        [
            f"station {station}",
            f"{each['latency_ms']:.2f}",
            f"{each['latency_correction_ms']:+.2f}",
            f"{each['latency_sigma_ms']:.2f}",
        ]
        for station, each in stations.items()
    ]
    print_table(["latency beside station 1", "ms", "corrected by", "sigma"], late)
    if positions:
        click.echo()
        print_table(
            ["prism", "x m", "y m", "z m", "sigma mm x", "y", "z"],
            [
                [str(prism), *(f"{v:.4f}" for v in position), *(f"{1e3 * v:.2f}" for v in sigmas[prism])]
                for prism, position in positions.items()
            ],
        )
    if found.judgement is not None:
        click.echo()
        _print_judgement(found.judgement)


def _print_judgement(judged: HeldOutComparison) -> None:
    rows = []
    for name, predicted in (("linear", judged.linear), ("before", judged.before), ("after", judged.after)):
        if predicted is not None:
            figures, gaps = predicted.statistics, predicted.gaps
            numbers = (figures.mean, figures.median, figures.p95, gaps.mean)
            rows.append([name, *(f"{number:.2f}" for number in numbers)])
    title = f"{judged.after.statistics.n} measurements left out, missed by mm"
    print_table([title, "mean", "median", "p95", f"mean of {judged.after.gaps.n} at gaps"], rows)
