"""The part of the poses' covariance that the set-up's uncertainty adds: against poses with a displaced set-up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.drives.scene import START, Motion, stationary_scene

from tsgt.analysis.processing import process, with_estimator
from tsgt.analysis.smoothing import smooth_recording
from tsgt.estimation import (
    Kind,
    PoseBatch,
    build_observations,
    parameter_names,
    setup_jacobian,
    uncertain_setup,
    with_setup,
)
from tsgt.estimation.continuous import ContinuousEstimator
from tsgt.geometry import exp_so3
from tsgt.geometry.batch import fit_trajectory
from tsgt.model import SetupCovariance
from tsgt.recording import Recording, RecordingHeader

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Trajectory
    from tsgt.model import Matrix4, Parameters

SHIFT_M = 0.002


def winding(time_s: float) -> Motion:
    """Return rotation and position of a robot that turns as it drives."""
    position = (30 + 1.5 * np.sin(0.8 * time_s), 20 - 1.2 * np.cos(1.1 * time_s), -1.0)
    return exp_so3(np.array([0.0, 0.0, 0.6 * np.sin(0.7 * time_s)])), np.array(position)


SCENE = stationary_scene().moving(winding)
MEASUREMENTS = [
    SCENE.measure(station, 0.4 * step + 0.11 * station) for step in range(30) for station in (1, 2, 3)
]


def uncertain() -> Parameters:
    """Return parameters whose second station has an uncertain position along x."""
    known = SetupCovariance(components=("station2.x",), matrix=((SHIFT_M**2,),))
    return replace(SCENE.parameters, setup_covariance=known)


def displaced(parameters: Parameters, shift_m: float) -> Parameters:
    """Shift the second station along x."""
    frame = np.array(parameters.stations[1].T_station1_station)
    frame[0, 3] += shift_m
    moved = replace(
        parameters.stations[1], T_station1_station=cast("Matrix4", tuple(map(tuple, frame.tolist())))
    )
    return replace(parameters, stations=(parameters.stations[0], moved, parameters.stations[2]))


def recorded(parameters: Parameters) -> Recording:
    """Return a recording of the drive."""
    return Recording(
        header=RecordingHeader(software="test", created_ns=0, source="test"),
        parameters=parameters,
        measurements=list(MEASUREMENTS),
        end_ns=MEASUREMENTS[-1].received_ns,
    )


def smoothed(parameters: Parameters) -> PoseBatch:
    """Process the drive with the set-up as it is."""
    recording = with_estimator(recorded(parameters), "continuous")
    return smooth_recording(recording, path=Path("drive.jsonl"), refine="off").poses


def fitted(parameters: Parameters) -> Trajectory:
    """Fit the trajectory with the motion prior of the live estimator."""
    observations, _ = build_observations(parameters, MEASUREMENTS, origin_ns=START)
    return fit_trajectory(
        observations,
        prior=parameters.pipeline.motion,
        noise_scale=1.0,
        rest=(),
        setup_jacobian=setup_jacobian(parameters),
    ).trajectory


def sigmas_m(covariance: FloatArray) -> FloatArray:
    """(N, 3) one sigma of the positions."""
    found: FloatArray = np.sqrt(np.diagonal(covariance[:, :3, :3], axis1=1, axis2=2))
    return found


def test_common_part_is_the_displacement_by_the_set_up() -> None:
    """A station that is off displaces all poses, between knots as well, by what the common covariance says."""
    at_s = np.arange(1.0, 10.0, 0.07)
    share = 0.1
    away, other = (
        fitted(displaced(SCENE.parameters, sign * share * SHIFT_M)).at(at_s)[0].position for sign in (1, -1)
    )
    common = fitted(uncertain()).common_at(at_s)
    assert common is not None
    half_m = 0.5 * np.abs(away - other) / share
    assert half_m.max() > 0.3 * SHIFT_M
    assert sigmas_m(common) == pytest.approx(half_m, abs=0.02 * SHIFT_M)


def test_covariance_is_the_sum_of_both_parts() -> None:
    """The random part is what is stated without an uncertain set-up; without one the common part is unknown."""
    found, exact = smoothed(uncertain()), smoothed(SCENE.parameters)
    assert np.isnan(exact.covariance_common).all()
    assert all(record.covariance_common is None for record in exact.records())
    np.testing.assert_allclose(
        found.covariance - found.covariance_common, exact.covariance, atol=1e-3 * exact.covariance.max()
    )


def live(parameters: Parameters, kind: Kind) -> PoseBatch:
    """Return the poses of a kind, from when the drive is well known."""
    estimator, batches = ContinuousEstimator(parameters), []
    for measurement in MEASUREMENTS:
        estimator.add(measurement)
        batches.append(estimator.advance(measurement.received_ns))
    poses = PoseBatch.concatenated(batches)
    return poses.select((poses.kind == kind) & (poses.stamp_ns > START + 5_000_000_000))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Kind.SMOOTHED, Kind.PREDICTED])
def test_common_part_of_live_poses(kind: Kind) -> None:
    """Live, a station that is off displaces poses by what the common covariance says."""
    share = 0.1
    away, other = (live(displaced(SCENE.parameters, sign * share * SHIFT_M), kind) for sign in (1, -1))
    found = live(uncertain(), kind)
    assert len(found) > 50
    half_m = 0.5 * np.abs(away.position_m - other.position_m) / share
    missed_m = np.abs(sigmas_m(found.covariance_common) - half_m)
    # The weight of a new measurement may change with the set-up, which is not of first order.
    assert np.mean(missed_m < 0.03 * SHIFT_M) > 0.9


@pytest.mark.parametrize(
    "component",
    ["station2.x", "station3.rotation_z", "station2.latency", "station1.vertical_index", "prism2.y"],
)
def test_common_part_of_linear_poses(component: str) -> None:
    """A set-up that is off displaces the poses of ``linear`` by the common covariance."""
    sigma = 1e-3 if component[-2:] in (".x", ".y", "cy") else 1e-4
    known = SetupCovariance(components=(component,), matrix=((sigma**2,),))
    recording = recorded(replace(SCENE.parameters, setup_covariance=known))
    path = Path("drive.jsonl")
    found = process(with_estimator(recording, "linear"), path=path)
    layout = uncertain_setup(SCENE.parameters)
    step = sigma * np.array([name == component for name in parameter_names(layout, SCENE.parameters)])
    if ".rotation" in component:
        step = layout.from_station_origins() @ step
    moved = with_setup(SCENE.parameters, layout, layout.retract(layout.reference, step), np.zeros((35, 35)))
    away = process(with_estimator(recorded(moved), "linear"), path=path)
    off_m = (
        away.position_m
        - process(with_estimator(recorded(SCENE.parameters), "linear"), path=path).position_m[: len(away)]
    )
    valid = found.valid & away.valid
    assert np.abs(off_m[valid]).max() > 1e-5
    # Straight lines distort the robot that turns, so that the fit is not exact.
    missed_m = np.abs(sigmas_m(found.covariance_common)[valid] - np.abs(off_m[valid]))
    assert np.quantile(missed_m, 0.9) < 0.05 * np.abs(off_m[valid]).max()
