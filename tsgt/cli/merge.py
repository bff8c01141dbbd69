"""The command ``merge``."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.merge import merge as merge_journals
from tsgt.cli.options import json_option, keep_going_option, path_type, recording_argument
from tsgt.cli.output import print_json
from tsgt.cli.recordings import refuse_to_replace, report_problem

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.merge import Merged, MergedJournal


@click.command()
@recording_argument
@click.argument("journals", type=path_type, nargs=-1, required=True, metavar="JOURNAL...")
@click.option(
    "--output",
    type=path_type,
    help="Write a new recording instead of adding to RECORDING; replaced if it exists.",
)
@keep_going_option
@json_option
def merge(
    *, recording: Path, journals: tuple[Path, ...], output: Path | None, keep_going: bool, as_json: bool
) -> None:
    """Put the stations' JOURNALs into the master's RECORDING.

    What the radio did not carry is added with its time on the master's clock; what is there already stays as it is,
    so a merge may be repeated. `tsgt process` uses what was added, `tsgt replay` passes over it.
    """
    refuse_to_replace([recording, *journals], output)
    merged = merge_journals(
        recording, journals, output=output, keep_going=keep_going, on_problem=report_problem
    )
    if merged.cut_bytes:
        click.echo(
            f"warning: {recording}: a torn last line of {merged.cut_bytes} bytes was cut off", err=True
        )
    for journal in merged.journals:
        if journal.skipped:
            click.echo(f"warning: {journal.path}: skipped: {journal.skipped}", err=True)
    if as_json:
        print_json(_json(merged))
        return
    for journal in merged.journals:
        if not journal.skipped:
            click.echo(f"{journal.path}: {_counts(journal)}")
    within = ""
    if merged.bounds_ns:
        within = f", times within {_quantile_ms(merged.bounds_ns, 0.5):.2f} ms (median), {_ms(merged.bounds_ns[-1]):.2f} ms (largest)"
    click.echo(f"{output or recording}: {merged.added} measurements added{within}")


def _counts(journal: MergedJournal) -> str:
    parts = [f"{journal.added} of {journal.measurements} measurements added"]
    for count, what in (
        (journal.already_there, "already there"),
        (journal.outside, "before or after the recording"),
        (journal.untimed, "without a time that is good enough"),
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
            "max": _ms(bounds_ns[-1]) if bounds_ns else None,
        },
        "journals": [
            {**dataclasses.asdict(journal), "path": str(journal.path)} for journal in merged.journals
        ],
    }


def _quantile_ms(bounds_ns: Sequence[int], share: float) -> float:
    return _ms(bounds_ns[round(share * (len(bounds_ns) - 1))])


def _ms(duration_ns: int) -> float:
    return duration_ns / 1e6
