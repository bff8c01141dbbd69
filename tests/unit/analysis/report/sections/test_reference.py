"""Section and figures of the errors against a reference."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("matplotlib")

from tsgt.analysis.evaluation import (
    Reference,
    compare,
    compare_aligned,
    error_components,
    error_details,
    pose_components,
    stationary_errors,
)
from tsgt.analysis.figures import TimeAxis, drawing
from tsgt.analysis.report.figures.components import draw_component_errors, draw_components
from tsgt.analysis.report.sections.trajectories import reference_section
from tsgt.estimation import Kind, PoseBatch, Reason

COUNT = 400
STAMP_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(COUNT)
AXIS = TimeAxis.over(int(STAMP_NS[0]), int(STAMP_NS[-1]))
CENTROID_M = np.array([0.0, 0.0, 1.0])


def drive(*, common: bool = False) -> tuple[PoseBatch, Reference]:
    """Return poses of a drive of 20 s with an outage and errors of 2 mm, and the truth."""
    random = np.random.default_rng(3)
    t = np.arange(COUNT) / 20
    position_m = np.stack([t, np.sin(t), np.zeros(COUNT)], axis=1)
    yaw = Rotation.from_euler("z", 0.5 * t[:, None])
    truth = Reference(STAMP_NS, position_m, yaw.as_quat())
    poses = PoseBatch.blank(STAMP_NS, (1, 2, 3), Kind.SMOOTHED)
    poses.position_m[:] = position_m + random.normal(scale=0.002, size=(COUNT, 3))
    poses.orientation_xyzw[:] = (
        Rotation.from_rotvec(random.normal(scale=0.002, size=(COUNT, 3))) * yaw
    ).as_quat()
    poses.covariance[:] = 4e-6 * np.eye(6)
    if common:
        poses.covariance_common[:] = 1e-6 * np.eye(6)
    poses.reason[200:240] = int(Reason.OUTAGE)
    return poses, truth


def findings(poses: PoseBatch, truth: Reference) -> Any:
    """Return what the section reads."""
    return SimpleNamespace(
        reference=truth,
        reference_errors={"continuous": compare(poses, truth, CENTROID_M)},
        error_details={"continuous": error_details(poses, truth)},
        aligned_errors={},
        problems={},
        stationary_errors={"continuous": stationary_errors(poses, truth, (), CENTROID_M).statistics()},
        poses=poses,
        point="the robot's origin",
        start_ns=int(STAMP_NS[0]),
        end_ns=int(STAMP_NS[-1]),
    )


def test_tables_have_the_numbers_of_the_json() -> None:
    """ATE equals the headline figure; RPE has a row for each distance, and one for a second."""
    f = findings(*drive())
    section = reference_section(f, AXIS)
    assert section is not None
    absolute, covariances, relative = section.tables
    keys = f.error_details["continuous"].keys()
    assert keys["ate"]["position_rms_mm"] == pytest.approx(f.reference_errors["continuous"].position_rms_mm)
    assert keys["ate"]["orientation_rms_deg"] == pytest.approx(
        f.reference_errors["continuous"].orientation_rms_deg
    )
    (row,) = absolute.rows
    assert row[:3] == ("continuous", str(keys["ate"]["n"]), f"{keys['ate']['position_rms_mm']:.1f}")
    assert covariances.rows[0][3] == f"{keys['components']['x_mm']['within_2_sigma']:.1%}"
    assert [row[0] for row in relative.rows] == ["continuous, 1 m", "continuous, 10 m", "continuous, 1 s"]
    assert "the robot's origin" in absolute.caption
    assert [plot.name for plot in section.plots] == ["reference_errors"]


def test_aligned_errors_fill_their_table() -> None:
    """Each column has a cell: at the pose's point and at the centroid."""
    poses, truth = drive()
    f = findings(poses, truth)
    f.aligned_errors = {"continuous": compare_aligned(poses, truth, CENTROID_M, "rigid")}
    section = reference_section(f, AXIS)
    assert section is not None
    (aligned,) = (each for each in section.tables if "Aligned" in each.caption)
    (row,) = aligned.rows
    assert len(row) == len(aligned.header)
    assert row[2] == f"{f.aligned_errors['continuous'].centroid.position_rms_mm:.1f}"


def test_missing_alignment_is_said() -> None:
    """With its reason; the unaligned errors are shown."""
    f = findings(*drive())
    f.problems = {"aligned": "the points lie in a line"}
    section = reference_section(f, AXIS)
    assert section is not None
    assert "Not aligned: the points lie in a line." in section.text
    assert len(section.tables) == 3


def test_reference_of_another_time_is_said() -> None:
    """There is no table then."""
    poses, truth = drive()
    later = Reference(truth.stamp_ns + 10**12, truth.position_m, truth.orientation_xyzw)
    section = reference_section(findings(poses, later), AXIS)
    assert section is not None
    assert "does not overlap" in section.text[0]
    assert not section.tables


@pytest.mark.parametrize("common", [False, True])
@pytest.mark.slow
def test_common_part_is_drawn_if_known(*, common: bool) -> None:
    """Dashed, so that it can be told apart without colour; the legend names it."""
    poses, truth = drive(common=common)
    for draw, series in (
        (draw_components, pose_components(poses)),
        (draw_component_errors, error_components(poses, truth)),
    ):
        with drawing(width_mm=180, height_mm=120) as figure:
            draw(figure, series, AXIS)
            labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
            dashed = [line for panel in figure.axes for line in panel.lines if line.get_linestyle() == "--"]
        assert any("common to all poses" in label for label in labels) == common
        assert bool(dashed) == common


def test_errors_are_not_connected_across_an_outage() -> None:
    """A line there would look like errors of poses that are not valid."""
    with drawing(width_mm=180, height_mm=120) as figure:
        draw_component_errors(figure, error_components(*drive()), AXIS)
        (line,) = [line for line in figure.axes[0].lines if line.get_label() == "error"]
        assert np.isnan(np.asarray(line.get_ydata(), dtype=float)).sum() == 1
