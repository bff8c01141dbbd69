"""Tables of the poses of the stream for ``tsgt evaluate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.cli.output import numbers, percent, print_table
from tsgt.estimation import point_label

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import LiveComparison
    from tsgt.model import Parameters


def print_live(found: LiveComparison, parameters: Parameters) -> None:
    """Print the errors as tables, positions at the reference point."""
    against = "the reference" if found.against == "reference" else "the post-processed trajectory"
    point = parameters.reference_point.name
    click.echo(f"\nStreamed poses against {against}, at {point_label(parameters.reference_point)}")
    rows = []
    for series, each in found.series.items():
        keys, errors = each.keys(), each.errors
        rows.append(
            [
                series,
                str(each.poses),
                f"{keys['valid_fraction']:.1%}",
                *numbers(
                    errors.position_rms_mm, errors.position_p95_mm, errors.centroid.position_rms_mm, digits=1
                ),
                *numbers(errors.orientation_rms_deg, errors.nees.mean),
                *map(percent, (errors.beyond_limits.position, errors.beyond_limits.rotation)),
                *map(percent, (errors.beyond_3_sigma.position, errors.beyond_3_sigma.rotation)),
            ]
        )
    print_table(
        [
            *(
                "kind",
                "n",
                "valid",
                f"{point} rms mm",
                f"{point} p95 mm",
                "centroid rms mm",
                "rms deg",
                "NEES (6)",
            ),
            *("beyond limits: mm", "deg", "beyond 3 sigma: mm", "deg"),
        ],
        rows,
    )
    click.echo(
        "\nBy age (ms): of the newest measurement of a predicted pose; of any other pose when it was sent"
    )
    rows = [
        [
            series,
            f"{bin_.from_ms:g} to {bin_.to_ms:g}" if bin_.to_ms is not None else f"over {bin_.from_ms:g}",
            str(bin_.compared),
            *numbers(bin_.position_rms_mm, bin_.position_median_mm, bin_.position_p95_mm, digits=1),
            *numbers(bin_.orientation_rms_deg, bin_.nees_mean),
        ]
        for series, each in found.series.items()
        for bin_ in each.errors.by_age
    ]
    of_point = [f"{point} {figure} mm" for figure in ("rms", "median", "p95")]
    print_table(["kind", "age ms", "n", *of_point, "rms deg", "NEES (6)"], rows)
