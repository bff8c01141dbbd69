"""The command ``merge``."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.merge import merge as merge_journals
from tsgt.cli.options import (
    RECORDING_SUFFIXES,
    OutputFile,
    json_option,
    keep_going_option,
    path_type,
    recording_argument,
)
from tsgt.cli.output import print_json, refuse_overwrite, report_problem

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.merge import Merged, MergedJournal


@click.command()
@recording_argument
@click.argument("journals", type=path_type, nargs=-1, required=True, metavar="JOURNAL...")
@click.option(
    "--output",
    type=OutputFile(*RECORDING_SUFFIXES),
    help="New recording to write (.jsonl) instead of appending to RECORDING; replaced if it exists.",
)
@keep_going_option
@json_option
def merge(
    *, recording: Path, journals: tuple[Path, ...], output: Path | None, keep_going: bool, as_json: bool
) -> None:
    """Add the stations' journals to a recording.

    Measurements that the radio did not deliver are appended to the master's RECORDING with their time on the master's
    clock. Existing measurements stay as they are, so a merge may be repeated. `tsgt process` uses the added
    measurements, `tsgt replay` ignores them.
    """
    refuse_overwrite([recording, *journals], output)
    merged = merge_journals(
        recording, journals, output=output, keep_going=keep_going, on_problem=report_problem
    )
    if merged.cut_bytes:
        click.echo(f"warning: {recording}: removed a torn last line of {merged.cut_bytes} bytes", err=True)
    for journal in merged.journals:
        if journal.skipped:
            click.echo(f"warning: {journal.path}: skipped: {journal.skipped}", err=True)
    if as_json:
        print_json(_json(merged))
        return
    for journal in merged.journals:
        if not journal.skipped:
            click.echo(f"{journal.path}: {_counts(journal)}")
    bounds = ""
    if merged.bounds_ns:
        median_ms, max_ms = _quantile_ms(merged.bounds_ns, 0.5), merged.bounds_ns[-1] / 1e6
        bounds = f", timestamp bound {median_ms:.2f} ms (median), {max_ms:.2f} ms (max)"
    click.echo(f"{output or recording}: {merged.added} measurements added{bounds}")


def _counts(journal: MergedJournal) -> str:
    parts = [f"{journal.added} of {journal.measurements} measurements added"]
    for count, what in (
        (journal.already_there, "already in the recording"),
        (journal.outside, "before or after the recording"),
        (journal.untimed, "without a sufficiently accurate time"),
    ):
        if count:
            parts.append(f"{count} {what}")
    return ", ".join(parts)


def _json(merged: Merged) -> dict[str, Any]:
    bounds_ns = merged.bounds_ns
    return {
        "added": merged.added,
        "already_there": merged.already_there,
        "bound_ms": {
            "p50": _quantile_ms(bounds_ns, 0.5) if bounds_ns else None,
            "max": bounds_ns[-1] / 1e6 if bounds_ns else None,
        },
        "journals": [
            {**dataclasses.asdict(journal), "path": str(journal.path)} for journal in merged.journals
        ],
    }


def _quantile_ms(bounds_ns: Sequence[int], share: float) -> float:
    return bounds_ns[round(share * (len(bounds_ns) - 1))] / 1e6
