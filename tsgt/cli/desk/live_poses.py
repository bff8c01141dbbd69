"""Poses of the stream for ``tsgt evaluate``: against a reference, else against the post-processed trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from tsgt.analysis.evaluation import (
    LivePoseErrors,
    LivePoses,
    Reference,
    interior_mask,
    read_streamed_poses,
)
from tsgt.cli.output import numbers, print_table
from tsgt.estimation import centroid_at_point, point_label, sigma_limits_of
from tsgt.geometry import rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.evaluation import StreamedPoses
    from tsgt.estimation import PoseBatch
    from tsgt.model import Parameters
    from tsgt.recording import Kind, Recording


@dataclass(frozen=True, slots=True)
class LiveComparison:
    """The poses of a stream by kind; ``against``: ``reference`` or ``post_processed``."""

    against: str
    kinds: dict[Kind, LivePoses]

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {"against": self.against, **{kind: each.keys() for kind, each in self.kinds.items()}}


def compare_live(
    loaded: Recording, path: Path, post_processed: PoseBatch, reference: Reference | None, *, keep_going: bool
) -> LiveComparison | None:
    """Compare the poses that a recording has as streamed; None without any, or with nothing to compare them with."""
    parameters = loaded.parameters
    streamed = read_streamed_poses(path, parameters.reference_point, keep_going=keep_going)
    true = _as_reference(post_processed) if reference is None else reference
    if not streamed or true is None:
        return None
    true = true.of_point(parameters.reference_point)
    return LiveComparison(
        "post_processed" if reference is None else "reference",
        {kind: _compare(poses, kind, true, parameters) for kind, poses in streamed.items()},
    )


def print_live(found: LiveComparison, parameters: Parameters) -> None:
    """Print the errors as tables, positions at the reference point."""
    against = "the reference" if found.against == "reference" else "the post-processed trajectory"
    point = parameters.reference_point.name
    click.echo(f"\nStreamed poses against {against}, at {point_label(parameters.reference_point)}")
    rows = []
    for kind, each in found.kinds.items():
        keys, errors = each.keys(), each.errors
        rows.append(
            [
                kind,
                str(each.poses),
                f"{keys['valid_fraction']:.1%}",
                *numbers(
                    errors.position_rms_mm, errors.position_p95_mm, errors.centroid.position_rms_mm, digits=1
                ),
                *numbers(errors.orientation_rms_deg, errors.nees.mean),
                *map(_percent, (errors.beyond_limits.position, errors.beyond_limits.rotation)),
                *map(_percent, (errors.beyond_3_sigma.position, errors.beyond_3_sigma.rotation)),
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
            kind,
            f"{bin_.from_ms:g} to {bin_.to_ms:g}" if bin_.to_ms is not None else f"over {bin_.from_ms:g}",
            str(bin_.compared),
            *numbers(bin_.position_rms_mm, bin_.position_median_mm, bin_.position_p95_mm, digits=1),
            *numbers(bin_.orientation_rms_deg, bin_.nees_mean),
        ]
        for kind, each in found.kinds.items()
        for bin_ in each.errors.by_age
    ]
    of_point = [f"{point} {figure} mm" for figure in ("rms", "median", "p95")]
    print_table(["kind", "age ms", "n", *of_point, "rms deg", "NEES (6)"], rows)


def _compare(poses: StreamedPoses, kind: Kind, true: Reference, parameters: Parameters) -> LivePoses:
    inner = interior_mask(poses.stamp_ns, int(true.stamp_ns[0]), int(true.stamp_ns[-1]))
    transforms, known = true.at(poses.stamp_ns)
    rows = inner & known
    estimated = transform_from(rotation_from_quaternion(poses.orientation_xyzw[rows]), poses.position_m[rows])
    errors = LivePoseErrors.of(
        estimated, poses.covariance[rows], poses.age_s[rows], transforms[rows], centroid_at_point(parameters)
    )
    limits = sigma_limits_of(kind, parameters.pipeline)
    return LivePoses(poses.poses, len(poses.stamp_ns), poses.age_s, errors.statistics(*limits))


def _as_reference(poses: PoseBatch) -> Reference | None:
    valid = poses.valid
    if valid.sum() < 2:
        return None
    return Reference(
        poses.stamp_ns[valid], poses.position_m[valid], poses.orientation_xyzw[valid], poses.reference_point
    )


def _percent(share: float) -> str:
    return f"{share:.2%}" if share == share else "-"
