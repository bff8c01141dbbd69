"""Report section on the poses that were streamed live. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.report.page import Section, Table, format_number, format_share

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import LiveComparison

_KINDS = {
    "predicted": "predicted (for now)",
    "smoothed": "smoothed (final, some seconds late)",
    "interpolated": "interpolated",
}


def _label(series: str) -> str:
    kind, _, delay = series.partition("_")
    return f"{kind} ({delay} late)" if delay else _KINDS[kind]


def live_section(found: LiveComparison | None, point: str) -> Section | None:
    """Return the section on the streamed poses; None without any. ``point``: whose positions are compared."""
    if found is None:
        return None
    against = (
        "the reference"
        if found.against == "reference"
        else "the post-processed trajectory, which has errors of its own"
    )
    text = (
        f"Valid poses as a controller received them during the drive, compared with {against}. Age: of the newest measurement "
        "before a predicted pose; of any other pose when it was sent. A pose is beyond its limit if its error exceeds the limit "
        "that its standard deviation must keep."
    )
    rows = [
        (
            _label(series),
            str(each.poses),
            format_share(each.keys()["valid_fraction"]),
            format_number(e.position_rms_mm),
            format_number(e.position_p95_mm),
            format_number(e.centroid.position_rms_mm),
            format_number(e.orientation_rms_deg, 2),
            format_number(e.nees.mean),
            *(format_share(share, 2) for share in (e.beyond_limits.position, e.beyond_limits.rotation)),
        )
        for series, each in found.series.items()
        for e in (each.errors,)
    ]
    header = (
        "kind", "poses", "valid", "rms (mm)", "95 % (mm)", "centroid rms (mm)", "rms (deg)",
        "squared error (NEES, expected 6)", "beyond the position limit", "beyond the rotation limit",
    )  # fmt: skip
    by_age = [
        (
            _label(series),
            f"{b.from_ms:g} to {b.to_ms:g}" if b.to_ms is not None else f"over {b.from_ms:g}",
            str(b.compared),
            *(format_number(value) for value in (b.position_rms_mm, b.position_median_mm, b.position_p95_mm)),
            format_number(b.orientation_rms_deg, 2),
            format_number(b.nees_mean),
        )
        for series, each in found.series.items()
        for b in each.errors.by_age
    ]
    tables = (
        Table(
            f"Errors of the streamed poses, position of {point}, beside it at the prisms' centroid",
            header,
            tuple(rows),
        ),
        Table(
            f"The same by age, position of {point}",
            (
                "kind",
                "age (ms)",
                "poses",
                "rms (mm)",
                "median (mm)",
                "95 % (mm)",
                "rms (deg)",
                "NEES (expected 6)",
            ),
            tuple(by_age),
        ),
    )
    return Section("Live poses", (text,), tables)
