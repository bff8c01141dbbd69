"""Scale of the covariance of predictions, from the errors that earlier predictions turned out to have. Sans-I/O.

How rough the ground is does not change at once: the vertical and the rotations about the two horizontal axes of the robot
are predicted about as well as during the last minute of driving. Speed and heading follow an operator, who may
steer after minutes of steady driving; their covariance stays that of the motion prior.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.trajectory.states import POSE_DIM, STATE_DIM, States, concatenate_states

if TYPE_CHECKING:
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.query import Trajectory

INTERVAL_S = 0.1  # Successive predictions rest on the same measurements
MEMORIES = np.array([[50], [600]])
"""Predictions whose errors count: five seconds, which react to rough ground, and a minute. The larger mean counts."""
INITIAL_WEIGHT = 200  # Predictions; until then the covariance of the motion prior has most of the weight
MIN_SCALE = 0.25  # Of a variance: rough ground after smooth ground must not exceed four sigmas
MIN_SPEED_MPS, MIN_RATE_RADPS = 0.05, 0.05
"""A robot that is slower counts as stationary: a stop of minutes says nothing about the ground that it will drive on."""

_AXES = np.array([2, 3, 4])  # Of a state's error: vertical, roll, pitch
_GROUPS = np.array([0, 1, 1])  # Roll and pitch share their scale: the robot may turn by 90 degrees


class PredictionErrorMonitor:
    """Compares predictions with the trajectory once later measurements have determined it."""

    def __init__(self) -> None:
        self._pending: deque[tuple[States, FloatArray]] = deque()
        self._recorded_s = -np.inf
        self._means = np.ones((2, 2))  # squared errors over variances, by memory and group of axes
        self._weights = np.minimum(MEMORIES, INITIAL_WEIGHT)

    def scaled(self, covariance: FloatArray) -> FloatArray:
        """Scale the covariance of a prediction, (1, N, N) of its leading error components."""
        factors = np.ones((3, 6))  # of sigmas; of positions and rotations, and of their derivatives
        factors[:, _AXES] = np.sqrt(np.clip(self._means.max(axis=0), MIN_SCALE, 1.0))[_GROUPS]
        sigmas = factors.reshape(STATE_DIM)[: covariance.shape[1]]
        return np.asarray(covariance * sigmas[:, None] * sigmas)

    def record(self, state: States, covariance: FloatArray) -> None:
        """Keep a prediction with its unscaled covariance, (1, N, N), to compare it later."""
        time_s = float(state.time_s[0])
        if time_s - self._recorded_s < INTERVAL_S:
            return
        if (
            math.hypot(*state.velocity[0].tolist()) > MIN_SPEED_MPS
            or math.hypot(*state.angular_velocity[0].tolist()) > MIN_RATE_RADPS
        ):
            self._recorded_s = time_s
            self._pending.append((state, np.diagonal(covariance[0])[_AXES]))

    def discard_before(self, before_s: float) -> None:
        """Drop the predictions before a time, without comparing them."""
        while self._pending and self._pending[0][0].time_s[0] < before_s:
            self._pending.popleft()

    def compare_before(self, before_s: float, trajectory: Trajectory) -> None:
        """Compare the predictions before a time, in the order of time."""
        some: list[tuple[States, FloatArray]] = []
        while self._pending and self._pending[0][0].time_s[0] < before_s:
            some.append(self._pending.popleft())
        if not some:
            return
        predicted = concatenate_states([state for state, _ in some])
        smoothed, covariance = trajectory.at(predicted.time_s, dim=POSE_DIM)
        errors = predicted.local_coordinates_about(smoothed)[:, _AXES]
        # The smoothed pose has an error too.
        squares = errors**2 + np.diagonal(covariance, axis1=1, axis2=2)[:, _AXES]
        ratios = squares / np.array([variances for _, variances in some])
        for vertical, roll, pitch in ratios.tolist():
            self._weights = np.minimum(self._weights + 1, MEMORIES)
            self._means += (np.array([vertical, 0.5 * (roll + pitch)]) - self._means) / self._weights
