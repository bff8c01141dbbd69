"""Checks of many poses against the truth, on made-up drives."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.records import PARAMETERS, START, measurement

from tsgt.geometry import quaternion_from_rotation
from tsgt.simulation.checks.poses.covariance_scale import mean_of_correlated, scale_failures
from tsgt.simulation.checks.poses.lateness import lateness_failures
from tsgt.simulation.checks.poses.rules import rule_failures
from tsgt.simulation.checks.poses.twists import twist_failures
from tsgt.simulation.mission.master_log import ValidPoses

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIGMA = 0.002


def _pose_at(at_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses on a circle of 5 m, at 1 m/s, looking ahead."""
    angle = 0.2 * at_s
    poses = np.tile(np.eye(4), (len(at_s), 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = 5 * np.cos(angle), 5 * np.sin(angle)
    poses[:, 0, 0], poses[:, 0, 1] = -np.sin(angle), -np.cos(angle)
    poses[:, 1, 0], poses[:, 1, 1] = np.cos(angle), -np.sin(angle)
    return poses


def _drive(*, late_s: float = 0.0, stamp_error_s: float = 0.0, stated: float = 1.0) -> tuple[Any, Any, Any]:
    """Return log, result and journals of a minute of smoothed poses, with errors of SIGMA in m and rad."""
    rng = np.random.default_rng(1)
    at_s = np.arange(0.0, 60.0, 0.05)
    poses = _pose_at(at_s - late_s - stamp_error_s)
    count = len(at_s)
    errors = np.repeat(
        rng.normal(scale=SIGMA, size=(count // 5, 3)), 5, axis=0
    )  # correlated over a quarter second
    columns: dict[str, Any] = {field: np.zeros((count, 1)) for field in ValidPoses.__dataclass_fields__}
    columns |= {
        "stamp_ns": np.rint(at_s * 1e9).astype(np.int64) + START,
        "position_m": poses[:, :3, 3] + errors,
        "orientation_xyzw": quaternion_from_rotation(poses[:, :3, :3]),
        "covariance": np.tile(np.eye(6) * (stated * SIGMA) ** 2, (count, 1, 1)),
        "series": np.full(count, "smoothed"),
        "unconfirmed": np.zeros(count, np.bool_),
    }
    measured = [
        replace(measurement(sequence), station=number, prism=number)
        for sequence in range(150)
        for number in (1, 2, 3)
    ]
    log = SimpleNamespace(
        valid_poses=lambda: ValidPoses(**columns),
        unix_at_zero_ns=START,
        measurements=measured,
        trackers=set(),
        parameters=None,
    )
    result = SimpleNamespace(
        parameters=PARAMETERS,
        true_poses=_pose_at,
        world=SimpleNamespace(pose_at=_pose_at),
        moves=(),
        rollovers=(),
    )
    reported = [
        SimpleNamespace(
            instrument_ms=400 * m.sequence,
            distance_m=m.slope_distance_m,
            true_ns=m.stamp_ns - START - round(stamp_error_s * 1e9),
        )
        for m in measured
    ]
    indices = {
        number: SimpleNamespace(
            station_log=SimpleNamespace(station=number, reported_distances=reported),
            find=lambda m: replace(m, instrument_time_ns=400_000_000 * m.sequence),
        )
        for number in (1, 2, 3)
    }
    return log, result, indices


@pytest.mark.parametrize(
    ("late_s", "stamp_error_s", "count"), [(0.0, 0.0, 0), (0.003, 0.0, 3), (-0.003, 0.0, 3), (0.0, 0.02, 0)]
)
def test_late_poses_are_detected(late_s: float, stamp_error_s: float, count: int) -> None:
    """By 3 ms, of all prisms; not if the stamps of the measurements are themselves late."""
    log, result, indices = _drive(late_s=late_s, stamp_error_s=stamp_error_s)
    assert len(list(lateness_failures(log, result, indices))) == count


@pytest.mark.parametrize(("stated", "count"), [(1.0, 0), (1.3, 0), (2.0, 1)])
def test_too_large_covariance_is_detected(stated: float, count: int) -> None:
    """That of the position, by four; the rotation of these poses is exact."""
    log, result, _ = _drive(stated=stated)
    found = [each for each in scale_failures(log, result) if "position" in each]
    assert len(found) == count


def test_covariance_may_allow_for_an_unconfirmed_imu() -> None:
    """Its set-up need not be wrong."""
    log, result, _ = _drive(stated=2.0)
    poses = log.valid_poses()
    log.valid_poses = lambda: replace(poses, unconfirmed=np.ones(len(poses.stamp_ns), np.bool_))
    assert not list(scale_failures(log, result))


def _check_twists(series: str = "smoothed", **changes: Any) -> list[str]:
    """Return what is found in poses whose velocities are changed."""
    log, result, _ = _drive()
    poses = replace(log.valid_poses(), series=np.full(len(log.valid_poses().stamp_ns), series))
    ahead, behind = (_pose_at((poses.stamp_ns - START) / 1e9 + step_s) for step_s in (0.01, -0.01))
    velocity = (ahead[:, :3, 3] - behind[:, :3, 3]) / 0.02
    columns = {
        "velocity_mps": velocity,
        "angular_velocity_radps": np.tile([0.0, 0.0, 0.2], (len(velocity), 1)),
    }
    columns |= {name: change(columns[name]) for name, change in changes.items()}
    log.valid_poses = lambda: replace(poses, **columns)
    return list(twist_failures(log, result))


def test_wrong_velocity_is_detected() -> None:
    """Of the other sign, along the robot's axes, or too small by a fifth; that of a right one is not."""
    assert not _check_twists()
    assert _check_twists(velocity_mps=lambda velocity: -velocity)
    assert _check_twists(velocity_mps=lambda velocity: np.roll(velocity, 1, axis=1))
    assert _check_twists(velocity_mps=lambda velocity: 0.8 * velocity)
    assert _check_twists(angular_velocity_radps=lambda rate: -rate)


@pytest.mark.parametrize(("series", "detected"), [("smoothed", True), ("interpolated", False)])
def test_few_noisy_measurements_may_spoil_interpolated_velocities(series: str, *, detected: bool) -> None:
    """One in forty is off by four times the turn rate; the others are right."""

    def spoil(rate: NDArray[np.float64]) -> NDArray[np.float64]:
        rate[::40, 0] += 0.8
        return rate

    assert bool(_check_twists(series, angular_velocity_radps=spoil)) is detected


@pytest.mark.parametrize(
    ("field", "row", "what"),
    [
        ("orientation_xyzw", (0.0, 0.0, 0.0, -1.0), "w < 0"),
        ("orientation_xyzw", (0.0, 0.0, 0.0, 1.1), "no unit"),
        ("sent_age_s", 2.9, "not sent 3 to 3.5 s"),
        ("sent_age_s", 3.6, "not sent 3 to 3.5 s"),
        ("residual_m", 0.051, "residual"),
        ("covariance", np.eye(6) * 0.06**2, "valid in spite of its sigma of the position"),
        ("covariance", np.diag([0.026**2] * 3 + [1e-6] * 3), "good in spite of its sigma of the position"),
        ("station_residual_m", 0.003, "not that of its stations"),
    ],
)
def test_pose_against_the_rules_is_detected(field: str, row: Any, what: str) -> None:
    """A single one of all."""
    log, result, _ = _drive()
    poses = log.valid_poses()
    count = len(poses.stamp_ns)
    poses = replace(
        poses,
        sent_age_s=np.full(count, 3.2),
        residual_m=np.full(count, 0.001),
        station_residual_m=np.full(count, 0.001),
        good=np.ones(count, dtype=bool),
    )
    log.valid_poses, log.epochs_ns = lambda: poses, {}
    assert not list(rule_failures(log, result.parameters))
    values = getattr(poses, field).copy()
    values[100] = row
    log.valid_poses = lambda: replace(poses, **{field: values})
    (found, *_) = rule_failures(log, result.parameters)
    assert what in found


@pytest.mark.parametrize(("removed", "count"), [([], 0), ([7], 1), ([7, 20], 1)])
def test_missing_epoch_is_detected(removed: list[int], count: int) -> None:
    """Valid or not, there is a pose for each epoch."""
    log, result, _ = _drive()
    poses = log.valid_poses().select(np.zeros(1200, dtype=bool))
    epochs_ns = [START + number * 50_000_000 for number in range(30) if number not in removed]
    log.valid_poses, log.epochs_ns = lambda: poses, {"smoothed": epochs_ns}
    assert len(list(rule_failures(log, result.parameters))) == count


def test_standard_error_of_correlated_values() -> None:
    """Independent values, each repeated for a block: as if there were only the blocks."""
    rng = np.random.default_rng(2)
    means = []
    for _ in range(200):
        values = np.repeat(rng.standard_normal(30), 40)
        means.append(mean_of_correlated(np.linspace(0.0, 59.95, 1200), values))
    found = np.array(means)
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.15)
