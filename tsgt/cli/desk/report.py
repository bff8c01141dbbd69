"""The report of ``tsgt evaluate``: found, drawn, and written to a folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.analysis.formats import read_still_intervals
from tsgt.analysis.report import figures_of, find, page, verdicts
from tsgt.cli.output import json_text, print_json
from tsgt.cli.recordings import TUNING, progress
from tsgt.errors import OutputFileError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.analysis.evaluation import Align, Reference
    from tsgt.analysis.report import Findings
    from tsgt.recording import Recording

HELD_OUT_UP_TO_S = 900.0
"""Predicting the measurements of a longer recording takes minutes, and is left to those who ask for it."""

PAGE_NAME = "report.html"
NUMBERS_NAME = "report.json"


def report_evaluation(
    recording: Recording,
    path: Path,
    folder: Path,
    *,
    reference: Reference | None,
    align: Align | None = None,
    odometry: Path | None,
    with_held_out: bool | None,
    as_json: bool,
) -> None:
    """Find what there is to tell of a recording, and write it.

    Parameters
    ----------
    recording
        Measurements and the parameters in force.
    path
        Its file.
    folder
        Where the report goes; made if it is not there.
    reference
        What to compare poses with, if anything.
    align
        How poses are aligned with it besides, if at all.
    odometry
        File that tells when the robot stood still; None: the measurements tell it.
    with_held_out
        Whether to leave measurements out and predict them; None: if the recording is short.
    as_json
        Print the numbers instead of the summary.
    """
    stamps = [m.stamp_ns for m in recording.measurements]
    if with_held_out is None:
        with_held_out = not stamps or max(stamps) - min(stamps) <= HELD_OUT_UP_TO_S * 1e9
    still_ns = None if odometry is None else read_still_intervals(odometry)
    with progress("evaluating", first=TUNING) as on_progress:
        findings = find(
            recording,
            path,
            reference=reference,
            align=align,
            with_held_out=with_held_out,
            still_ns=still_ns,
            on_progress=on_progress,
        )
    with progress("drawing") as on_progress:
        write_report(findings, folder, on_progress=on_progress)
    if as_json:
        print_json(figures_of(findings))
        return
    for verdict in verdicts(findings):
        click.echo(f"{verdict.level.value}: {verdict.text}")
    click.echo(f"\n{folder / PAGE_NAME}")


def write_report(
    findings: Findings, folder: Path, *, on_progress: Callable[[float], None] | None = None
) -> None:
    """Write the page, all its figures as PNG and PDF, and its numbers as JSON.

    Raises
    ------
    OutputFileError
        A file cannot be written.
    MissingExtraError
        matplotlib is not installed.
    """
    from tsgt.analysis.report import facts, sections

    try:
        folder.mkdir(parents=True, exist_ok=True)
        made = sections(findings)
        plots = [plot for section in made for plot in section.plots]
        images = {}
        for number, plot in enumerate(plots, start=1):
            files = [folder / f"{plot.name}{ending}" for ending in (".png", ".pdf")]
            plot.write(files)
            images[plot.name] = files[0].read_bytes()
            if on_progress is not None:
                on_progress(number / len(plots))
        text = page(f"Report of {findings.path.name}", facts(findings), verdicts(findings), made, images)
        (folder / PAGE_NAME).write_text(text, encoding="utf-8")
        (folder / NUMBERS_NAME).write_text(json_text(figures_of(findings)) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputFileError(error.strerror or str(error), path=folder) from error
