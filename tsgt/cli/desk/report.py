"""Verdict and report of ``tsgt evaluate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.evaluation import distances_at_epochs, outliers, residual_statistics
from tsgt.analysis.formats import read_stationary_intervals
from tsgt.analysis.report import (
    Findings,
    Images,
    collect_findings,
    headline,
    map_figure,
    render_page,
    report_numbers,
    report_sections,
    verdicts,
)
from tsgt.analysis.report.findings import distances_problem
from tsgt.analysis.report.log import read_log
from tsgt.analysis.report.motion import distance_error_series
from tsgt.analysis.report.stations import station_records, station_statistics
from tsgt.analysis.text_file import utf8_name
from tsgt.analysis.validation import plausible_measurements
from tsgt.cli.desk.reference import not_aligned, not_compared
from tsgt.cli.output import CHECK_FAILED, json_text, print_json, refuse_overwrite
from tsgt.cli.progress import TUNING, progress
from tsgt.cli.recordings import write_lines
from tsgt.errors import OutputFileError, RecordingError, TsgtError
from tsgt.estimation import build_tracks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.diagnosis import Diagnosis
    from tsgt.analysis.evaluation import Align, InterPrismDistances, PoseErrorStatistics, Reference
    from tsgt.analysis.processing import Estimator
    from tsgt.analysis.refinement import Refine
    from tsgt.analysis.report import Headline, ReportFigure, Section
    from tsgt.analysis.report.verdicts import Verdict
    from tsgt.analysis.smoothing import SmoothedRecording
    from tsgt.recording import Recording

PAGE_NAME = "report.html"
NUMBERS_NAME = "report.json"


def refuse_report(inputs: Iterable[Path | None], folder: Path) -> None:
    """Reject a folder in which the report would replace one of its inputs."""
    given = list(inputs)
    for name in (PAGE_NAME, NUMBERS_NAME):
        refuse_overwrite(given, folder / name)


def assess(
    recording: Recording,
    path: Path,
    continuous: SmoothedRecording,
    distances: InterPrismDistances,
    compared: dict[Estimator, PoseErrorStatistics],
    diagnosis: Diagnosis | None,
) -> list[Verdict]:
    """Return the verdicts on an evaluated recording, without what only a report computes."""
    parameters = recording.parameters
    measurements = plausible_measurements(recording)
    stamps = [m.stamp_ns for m in measurements]
    start_ns, end_ns = min(stamps), max(stamps)
    records = station_records(measurements, [s.station for s in parameters.stations])
    limit_ns = parameters.pipeline.outage_limit_ns
    tracks = build_tracks(parameters, measurements)
    problems = distances_problem(tracks)
    epochs = None if problems else distances_at_epochs(parameters, tracks)
    findings = Findings(
        recording=recording,
        path=path,
        start_ns=start_ns,
        end_ns=end_ns,
        log=read_log(path),
        station_records=records,
        station_statistics={
            each.station: station_statistics(each, start_ns=start_ns, end_ns=end_ns, outage_limit_ns=limit_ns)
            for each in records
        },
        inter_prism=None if problems else distances,
        distance_errors=None
        if epochs is None
        else distance_error_series(parameters, epochs, continuous.poses),
        continuous=continuous,
        residuals=residual_statistics(continuous.fit, continuous.sources),
        outliers=outliers(continuous.fit, continuous.sources),
        reference_errors=compared,
        diagnosis=diagnosis,
        problems=problems,
    )
    return verdicts(findings)


def print_verdicts(found: Sequence[Verdict]) -> None:
    """Print verdicts, the worst first."""
    for verdict in found:
        click.echo(f"{verdict.level.value}: {f'{verdict.text} {verdict.repair}'.rstrip()}")


def report_evaluation(
    recording: Recording,
    path: Path,
    folder: Path,
    *,
    reference: Reference | None,
    reference_path: Path | None = None,
    align: Align | None = None,
    odometry: Path | None,
    with_held_out: bool,
    refine: Refine,
    as_json: bool,
) -> int:
    """Evaluate a recording and write the report.

    Parameters
    ----------
    recording, path
        Measurements with the parameters in force, and their file.
    folder
        Folder of the report, created if necessary.
    reference, reference_path
        Trajectory to compare poses with, and its file.
    odometry
        File that defines the stationary intervals; None: from the measurements.
    with_held_out
        Whether to compute the held-out prediction error.
    refine
        What of the set-up may be refined.
    as_json
        Print the numbers instead of the verdicts.

    Returns
    -------
    The exit code. Where there are no poses, or they cannot be compared with the reference, the report is written, and the last line
    is the error of the command without a report.
    """
    stationary_ns = None if odometry is None else read_stationary_intervals(odometry)
    with progress("evaluating", first=TUNING) as on_progress:
        findings = collect_findings(
            recording,
            path,
            reference=reference,
            align=align,
            with_held_out=with_held_out,
            refine=refine,
            stationary_ns=stationary_ns,
            on_progress=on_progress,
        )
    with progress("drawing") as on_progress:
        write_report(findings, folder, on_progress=on_progress)
    if as_json:
        print_json(report_numbers(findings))
    else:
        print_verdicts(verdicts(findings))
        click.echo(f"\n{folder / PAGE_NAME}")
    missing = _missing(findings, reference_path, align)
    if missing is None:
        return 0
    click.echo(f"error: {missing}", err=True)
    return CHECK_FAILED


def _missing(findings: Findings, reference_path: Path | None, align: Align | None) -> TsgtError | None:
    """Return an error if there are no poses, or none was compared or aligned with the reference."""
    if findings.poses is None:
        return RecordingError(findings.problems["continuous"], path=findings.path)
    if findings.reference is None or reference_path is None:
        return None
    if not any(found.compared for found in findings.reference_errors.values()):
        paths = (findings.path, reference_path)
        return not_compared(findings.poses_by_estimator.values(), findings.reference, paths)
    if "aligned" in findings.problems:
        return not_aligned(findings.problems["aligned"], align, reference_path)
    return None


def write_report(
    findings: Findings, folder: Path, *, on_progress: Callable[[float], None] | None = None
) -> None:
    """Write the page, its figures as PNG and PDF, and its numbers as JSON.

    Raises
    ------
    OutputFileError
        A file cannot be written.
    """
    write_page(
        folder,
        f"Report of {utf8_name(findings.path.name)}",
        headline(findings),
        map_figure(findings),
        report_sections(findings),
        report_numbers(findings),
        on_progress=on_progress,
    )


def write_page(
    folder: Path,
    title: str,
    head: Headline,
    path_map: ReportFigure | None,
    made: Sequence[Section],
    figures: Mapping[str, Any],
    *,
    on_progress: Callable[[float], None] | None = None,
) -> None:
    """Write a page, its figures as PNG and PDF, and its numbers as JSON, into a folder.

    Raises
    ------
    OutputFileError
        A file cannot be written.
    """
    from tsgt.analysis.figures import palette_png

    try:
        folder.mkdir(parents=True, exist_ok=True)
        plots = [*filter(None, [path_map]), *(plot for section in made for plot in section.plots)]
        images = {}
        for number, plot in enumerate(plots, start=1):
            files = [folder / f"{plot.name}{suffix}" for suffix in (".png", ".pdf")]
            plot.write(files)
            images[plot.name] = Images(*map(palette_png, (files[0].read_bytes(), plot.narrow_png())))
            if on_progress is not None:
                on_progress(number / len(plots))
        text = render_page(title, head, path_map, made, images)
        write_lines(folder / PAGE_NAME, [text])
        write_lines(folder / NUMBERS_NAME, [json_text(figures), "\n"])
    except OSError as error:
        raise OutputFileError(error.strerror or str(error), path=folder) from error
