"""Report section on the calibration: residuals of the targets from which the station frames were solved. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.figures import hatch, stroke
from tsgt.analysis.report.page import ReportFigure, Section, Table, format_number
from tsgt.model import PolarMeasurement

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

    from tsgt.model import TargetResidual
    from tsgt.recording import Recording

TITLE = "Targets from which the station frames were solved"


def calibration_section(recording: Recording) -> Section:
    """Return the target residuals, or why they are unknown."""
    found = _targets(recording)
    if not found:
        if not any(isinstance(m, PolarMeasurement) for m in recording.measurements):
            return Section(
                TITLE, ("The measurements are points in frame station1: no station frame is used.",)
            )
        reason = (
            "The recording contains no residuals of the targets from which the station frames were solved. It does if "
            "the frames are a file written by `tsgt calibrate targets --output`."
        )
        return Section(TITLE, (reason,))
    rows = [
        (
            str(station),
            str(target.target),
            "rejected" if target.residual_m is None else _mm(target.residual_m),
            _mm(target.leave_one_out_m),
        )
        for station, targets in found.items()
        for target in targets
    ]
    text = [
        f"Station {station}: {len(used)} targets used, root mean square {_mm(_rms(used))} mm."
        for station, targets in found.items()
        for used in (_used(targets),)
    ]
    others = [
        str(s.station)
        for s in recording.parameters.stations
        if s.station not in found and not _is_world(s.T_station1_station)
    ]
    if others:
        text.append(f"The targets of station {' and '.join(others)} are unknown.")
    table = Table(
        "Distance of each target, measured by the station, from its position measured by station 1",
        ("station", "target", "residual (mm)", "leave-one-out (mm)"),
        tuple(rows),
    )
    plot = ReportFigure(
        "calibration",
        "Disagreement between stations about each target",
        "Distance of each target from its position measured by station 1: residual in the solved frame, and (white) "
        "leave-one-out, in the frame solved from the other targets. A single large bar indicates a disturbed or badly aimed "
        "target, large bars of all targets a wrong target constant. Crosses: rejected targets, whose bars may exceed the axis.",
        24.0 + 30.0 * len(found),
        lambda figure: draw_targets(figure, found),
    )
    return Section(TITLE, tuple(text), (table,), (plot,))


def calibration_numbers(recording: Recording) -> dict[int, Any]:
    """Return the same numbers for ``--json``, by station number."""
    return {
        station: {
            "rms_mm": 1e3 * _rms(_used(targets)),
            "targets": [
                {
                    "target": t.target,
                    "residual_mm": None if t.residual_m is None else 1e3 * t.residual_m,
                    "leave_one_out_mm": None if t.leave_one_out_m is None else 1e3 * t.leave_one_out_m,
                }
                for t in targets
            ],
        }
        for station, targets in _targets(recording).items()
    }


def draw_targets(figure: Figure, found: Mapping[int, Sequence[TargetResidual]]) -> None:
    """Draw a panel of bars for each station, one pair for each target."""
    panels = figure.subplots(len(found), 1, squeeze=False, sharey=True)[:, 0]
    for panel, (station, targets) in zip(panels, found.items(), strict=True):
        places = np.arange(len(targets), dtype=np.float64)
        heights = [
            [math.nan if value is None else 1e3 * value for value in column]
            for column in ([t.residual_m for t in targets], [t.leave_one_out_m for t in targets])
        ]
        panel.bar(places - 0.2, heights[0], 0.38, color=stroke(1).color, label="residual")
        panel.bar(
            places + 0.2,
            heights[1],
            0.38,
            color="white",
            edgecolor="black",
            hatch=hatch(1),
            label="leave-one-out",
        )
        rejected = [place for place, target in zip(places, targets, strict=True) if target.residual_m is None]
        if rejected:
            panel.plot(
                np.array(rejected) - 0.2,
                np.full(len(rejected), 0.06),
                transform=panel.get_xaxis_transform(),
                linestyle="none",
                marker="x",
                color="black",
                label="rejected",
            )
        panel.set_xticks(places, [str(target.target) for target in targets])
        panel.grid(visible=False, axis="x")
        panel.set_title(f"station {station}", loc="left")
        panel.set_ylabel("mm")
    # A rejected target may have a hundred times the residual, which would hide the others.
    used = [t for targets in found.values() for t in targets if t.residual_m is not None]
    most_m = max((value or 0.0 for t in used for value in (t.residual_m, t.leave_one_out_m)), default=0.0)
    panels[0].set_ylim(0.0, 1.4e3 * max(most_m, 1e-4))
    panels[0].legend(loc="upper right", ncols=3)
    panels[-1].set_xlabel("target")


def _targets(recording: Recording) -> dict[int, tuple[TargetResidual, ...]]:
    return {s.station: s.targets for s in recording.parameters.stations if s.targets}


def _used(targets: Sequence[TargetResidual]) -> list[float]:
    return [target.residual_m for target in targets if target.residual_m is not None]


def _rms(residuals_m: Sequence[float]) -> float:
    return math.sqrt(sum(r**2 for r in residuals_m) / len(residuals_m)) if residuals_m else math.nan


def _mm(length_m: float | None) -> str:
    return format_number(math.nan if length_m is None else 1e3 * length_m, 2)


def _is_world(frame: Sequence[Sequence[float]]) -> bool:
    return bool(np.array_equal(np.array(frame), np.eye(4)))
