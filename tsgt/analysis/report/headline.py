"""Box at the top of a report: a few figures, what to trust, what not, and what to do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.report.numbers import pose_numbers
from tsgt.analysis.report.page import Headline, format_number
from tsgt.analysis.report.verdicts import Level, verdicts
from tsgt.estimation import Kind

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.analysis.report.findings import Findings


def headline(f: Findings) -> Headline:
    """Return the headline of a report."""
    found = verdicts(f)
    prefix = {Level.BAD: "Do not trust: ", Level.CARE: ""}
    return Headline(
        key_figures=tuple(_key_figures(f)),
        trust=tuple(v.text for v in found if v.level is Level.GOOD),
        caution=tuple(prefix[v.level] + v.text for v in found if v.level in prefix),
        # Each once, those of the worst verdicts first.
        repairs=tuple(dict.fromkeys(v.repair for v in found if v.repair)),
    )


def _key_figures(f: Findings) -> Iterator[tuple[str, str]]:
    poses = f.poses
    if poses is None:
        yield "valid poses", "none"
        return
    estimator = Kind(poses.kind[0]).estimator
    yield f"valid poses ({estimator})", f"{math.floor(1e3 * float(np.mean(poses.valid))) / 10:.1f} %"
    numbers = pose_numbers(poses, f.recording.parameters)
    sigma_mm, sigma_deg = numbers["position_sigma_mm"]["median"], numbers["rotation_sigma_deg"]["median"]
    yield f"stated standard deviation per axis, position of {f.point}", f"{format_number(sigma_mm)} mm"
    yield "stated standard deviation per axis, rotation", f"{format_number(sigma_deg, 2)} deg"
    details = f.error_details.get(estimator)
    if details is not None and details.ate.n:
        yield (
            f"error against the reference (rms), position of {f.point}",
            f"{details.ate.position_mm.rms:.1f} mm",
        )
        yield "error against the reference (rms), rotation", f"{details.ate.orientation_deg.rms:.2f} deg"
    if f.held_out is not None:
        with_imu = estimator == "continuous" and f.continuous is not None and f.continuous.imu is not None
        mean_mm = f.held_out["continuous_imu" if with_imu else estimator].statistics.mean
        yield "mean error of predicting held-out measurements of prisms", f"{format_number(mean_mm)} mm"
