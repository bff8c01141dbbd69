from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import compare, read_tum
from tsgt.analysis.evaluation.metrics import NeesStatistics
from tsgt.errors import InputFileError
from tsgt.estimation import Kind, PoseBatch, Reason

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_700_000_000_050_000_000
ROW = "{} {} 0 0 0 0 {} {}"


def written(path: Path, *, count: int = 201, step_ns: int = 50_000_000) -> Path:
    """Write a robot that moves along x at 1 m/s and rotates left at 0.1 rad/s."""
    rows = []
    for i in range(count):
        t = i * step_ns / 1e9
        stamp = f"{(START_NS + i * step_ns) // 10**9}.{(START_NS + i * step_ns) % 10**9:09d}"
        rows.append(ROW.format(stamp, t, math.sin(0.05 * t), math.cos(0.05 * t)))
    path.write_text("# stamp x y z qx qy qz qw\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def poses(stamp_ns: np.ndarray, *, offset_m: float = 0.0) -> PoseBatch:
    """Return poses of that robot with a lateral offset, with a sigma of 1 mm and 1 mrad."""
    batch = PoseBatch.blank(stamp_ns, (1, 2, 3), Kind.SMOOTHED)
    t = (stamp_ns - START_NS) / 1e9
    batch.position_m[:] = np.stack([t, np.full(len(t), offset_m), np.zeros(len(t))], axis=1)
    batch.orientation_xyzw[:] = Rotation.from_rotvec(np.stack([0 * t, 0 * t, 0.1 * t], axis=1)).as_quat()
    batch.covariance[:] = 1e-6 * np.eye(6)
    return batch


def test_timestamps_are_read_to_the_nanosecond(tmp_path: Path) -> None:
    """A float would lose them."""
    path = tmp_path / "r.tum"
    path.write_text("1700000000.000000001 0 0 0 0 0 0 1\n1700000000.050000003 0 0 0 0 0 0 2\n")
    found = read_tum(path)
    assert found.stamp_ns.tolist() == [1_700_000_000_000_000_001, 1_700_000_000_050_000_003]
    np.testing.assert_array_equal(found.orientation_xyzw[1], (0, 0, 0, 1))


def test_reference_is_interpolated(tmp_path: Path) -> None:
    """Linear and slerp between neighbours at most 0.1 s apart; nothing beyond its ends or across a gap."""
    reference = read_tum(written(tmp_path / "r.tum"))
    asked = START_NS + np.array([-1, 0, 12_345_678, 10_000_000_000, 10_000_000_001])
    found, known = reference.at(asked)
    assert known.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(found[1:4, 0, 3], [0.0, 0.012345678, 10.0], atol=1e-9)
    np.testing.assert_allclose(
        Rotation.from_matrix(found[1:4, :3, :3]).as_rotvec()[:, 2], [0.0, 0.0012345678, 1.0], atol=1e-9
    )
    slow = read_tum(written(tmp_path / "s.tum", count=5, step_ns=200_000_000))
    _, known = slow.at(START_NS + np.array([0, 1, 100_000_000, 200_000_000]))
    assert known.tolist() == [True, False, False, True]


def test_only_valid_poses_in_the_interior_count(tmp_path: Path) -> None:
    """Two seconds at either end are excluded; 3 mm at a sigma of 1 mm is a NEES of 9."""
    reference = read_tum(written(tmp_path / "r.tum"))
    batch = poses(START_NS + np.arange(201) * 50_000_000, offset_m=0.003)
    batch.reason[100] = Reason.OUTAGE
    found = compare(batch, reference, np.zeros(3))
    assert found.compared == 120
    assert found.position_rms_mm == pytest.approx(3.0, abs=1e-6)
    assert found.orientation_rms_deg == pytest.approx(0.0, abs=1e-5)
    assert found.nees.mean == pytest.approx(9.0, abs=1e-6)
    assert found.nees.max == pytest.approx(9.0, abs=1e-6)
    assert found.nees.above_95 == 0.0


def test_nees_of_consistent_covariances_is_six() -> None:
    """Oracle: errors drawn from covariances; 5 % of them are above the 95th percentile."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(20_000, 6)) @ root.T
    found = NeesStatistics.of(errors, np.broadcast_to(root @ root.T, (20_000, 6, 6)))
    assert found.mean == pytest.approx(6.0, abs=0.1)
    assert found.above_95 == pytest.approx(0.05, abs=0.006)


def test_no_valid_poses_give_nan(tmp_path: Path) -> None:
    """An estimator without valid poses cannot be compared."""
    batch = poses(START_NS + np.arange(201) * 50_000_000)
    none = replace(batch, reason=np.full(201, Reason.OUTAGE, np.int8))
    found = compare(none, read_tum(written(tmp_path / "r.tum")), np.zeros(3))
    assert found.compared == 0
    assert math.isnan(found.position_rms_mm)
    assert math.isnan(found.nees.mean)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "fewer than two poses"),
        ("1.0 0 0 0 0 0 0 1\n", "fewer than two poses"),
        ("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 1\n", "line 2: is not a pose"),
        ("1.0 0 0 0 0 0 0 1\nsoon 0 0 0 0 0 0 1\n", "line 2: is not a pose"),
        ("1.0 0 0 0 0 0 0 1\nnan 0 0 0 0 0 0 1\n", "line 2: is not a pose"),
        ("1.0 0 0 0 0 0 0 1\n2.0 0 0 inf 0 0 0 1\n", "line 2: is not a pose"),
        ("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 0\n", "line 2: is not a pose"),
        ("2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", "line 2: its time is not later than"),
        ("-1.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", "line 1: is not a pose"),
    ],
)
def test_invalid_trajectory_is_rejected(tmp_path: Path, text: str, problem: str) -> None:
    """With the line."""
    path = tmp_path / "r.tum"
    path.write_text(text)
    with pytest.raises(InputFileError, match=problem):
        read_tum(path)


@pytest.mark.parametrize("stamp", ["1e900000", "-1e900000", "1e-900000"])
def test_huge_exponent_is_not_expanded(tmp_path: Path, stamp: str) -> None:
    """It would take half a minute; the small one is zero."""
    path = tmp_path / "r.tum"
    path.write_text(f"{stamp} 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n")
    start_s = time.process_time()
    with pytest.raises(InputFileError, match=r"is not a pose|not later than"):
        read_tum(path)
    assert time.process_time() - start_s < 1.0


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    """As editors of Windows write it, before a comment or a pose."""
    path = tmp_path / "r.tum"
    for comment in ("", "# reference_point: tip=1,2,3,0,0,0,1\n"):
        path.write_text(f"{comment}1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", encoding="utf-8-sig")
        assert read_tum(path).reference_point.name == ("tip" if comment else "robot")


def test_missing_file_is_named(tmp_path: Path) -> None:
    """As with any other problem."""
    with pytest.raises(InputFileError, match=r"r\.tum: cannot be read"):
        read_tum(tmp_path / "r.tum")
