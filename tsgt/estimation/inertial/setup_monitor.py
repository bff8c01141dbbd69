"""Checks the configuration of the robot's IMU while the robot drives, from the start. Sans-I/O.

The last 50 s of measurements and samples are compared (`geometry.inertial_calibration.check_imu_setup`), every 4 s (6 s with fewer than three prisms) until the
set-up is confirmed, then every 20 s. What a check finds stands until a later one rules it out. A check takes a quarter of a
second of computing, one of fewer than three prisms 1.2 s: it may run beside, and its result counts a fixed time after its start, so that a replay gives the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.estimation.inertial.samples import inertial_samples
from tsgt.estimation.noise_scales import noise_scales
from tsgt.estimation.observations import build_observations, centroid_m
from tsgt.geometry import rotation_from_quaternion
from tsgt.geometry.batch import fit_trajectory, scale_noise
from tsgt.geometry.inertial import (
    Gravity,
    Mounting,
    fit_inertial_trajectory,
    judge_magnitudes,
    usable_samples,
)
from tsgt.geometry.inertial_calibration import (
    MIN_CHECKED_MEASUREMENTS,
    SetupCheck,
    check_few_prisms,
    check_imu_setup,
)
from tsgt.model import MIN_PRISMS
from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tsgt.geometry.inertial_calibration import Cause, SetupFinding
    from tsgt.model import ImuSamples, Measurement, Parameters

StartCheck = Callable[[Callable[[], SetupCheck]], Callable[[], SetupCheck]]
"""Starts a computation, and returns what waits for its result."""

WINDOW_NS = 50_000_000_000
FIRST_NS = 12_000_000_000  # Of measurements before the first check: fewer do not tell the mounting
UNCONFIRMED_INTERVAL_NS = 4_000_000_000
SILENT_NS = 1_000_000_000  # Without a record for this long the measurements' time bounds the records, too
INTERVAL_NS = 20_000_000_000
SHOCK_INTERVAL_NS = 1_000_000_000  # Samples of shocks that are closer are of one
UNWATCHED_NS = 5_000_000_000  # Without samples for longer, a knock may have been missed: somebody may have plugged the IMU in again
RESULT_NS, RESULT_FEW_NS = 2_000_000_000, 6_000_000_000
"""From the start of a check to its result, which the master waits for from then on. A slow computer takes a second; with fewer than three
prisms, where the trajectory is fitted with the samples, five.
"""

MAX_FIT_ITERATIONS, MAX_JOINT_ITERATIONS = 40, 30
"""Of a check that says something. Drives need up to 29 and 21. With prisms of another robot among the measurements a check took more,
and ten times as long, while the master waited for its result; what comes of it is not to be trusted either.
"""

UNSAMPLED_S = 2.0  # By which measurements may precede the samples that they are compared with

_CONFIRMATION = "mounting, latency, axes and units of the IMU agree with the drive"
_CONFIRMATION_BY_PRISMS = {
    1: "position and latency of the IMU agree with the drive; a single prism does not tell its rotation",
    2: "mounting and latency of the IMU agree with the drive, but for a rotation about the line of both prisms",
}

_PARTS: dict[Cause, str] = {
    "axes": "axes and units",
    "rotation": "mounting",
    "position": "position",
    "latency": "latency",
}

_REMEDIES: dict[Cause, str] = {
    "unit_of_rate": "let its program give rad/s",
    "unit_of_force": "let its program give m/s^2",
    "gravity_sign": "let its program give the specific force, which points up at rest",
    "axes": "correct orientation_xyzw or the axes that its program gives",
    "rotation": "calibrate it: tsgt calibrate imu",
    "position": "calibrate it: tsgt calibrate imu",
    "latency": "calibrate it: tsgt calibrate imu; or check the clock of the computer that stamps the samples",
    "unrelated": "check which device the program reads, and its clock",
}
MOVE_CAUSES: frozenset[Cause] = frozenset({"rotation", "position"})
"""Errors of the set-up that come about when the IMU, a tripod or a prism moves."""
_REMEDY_IF_MOVED = "it was right before, so the IMU, a tripod or a prism has moved: tsgt calibrate check tells whether it was a tripod"


def start_now(work: Callable[[], SetupCheck]) -> Callable[[], SetupCheck]:
    """Compute at once."""
    result = work()
    return lambda: result


def check_recorded_setup(
    parameters: Parameters, measurements: Iterable[Measurement], records: Iterable[ImuSamples]
) -> SetupCheck:
    """Compare the configured IMU with measurements and samples of up to a minute."""
    imu = parameters.imu
    measurements = list(measurements)
    if imu is None or not measurements:
        return SetupCheck()
    origin_ns = measurements[0].stamp_ns
    observations, _ = build_observations(parameters, measurements, origin_ns=origin_ns)
    few_prisms = len(parameters.prisms) < MIN_PRISMS
    # Of three prisms, a few measurements may show gross errors.
    least = MIN_CHECKED_MEASUREMENTS if few_prisms else 1
    if len(observations) < least:
        return SetupCheck()
    samples = usable_samples(inertial_samples(records, imu, origin_ns), imu)
    if not len(samples):
        return SetupCheck()
    # A backlog arrives with measurements of times whose samples are held no more.
    observations = observations.select(observations.time_s >= samples.end_s[0] - UNSAMPLED_S)
    if len(observations) < least:
        return SetupCheck()
    rotation = rotation_from_quaternion(np.array(imu.orientation_xyzw))
    mounting = Mounting(rotation, np.array(imu.position_m) - centroid_m(parameters))
    observations = scale_noise(observations, noise_scales(parameters))
    try:
        if few_prisms:
            with_imu = fit_inertial_trajectory(observations, samples, imu, reference_m=centroid_m(parameters))
            knots = with_imu.trajectory.knots
            states, _ = with_imu.trajectory.at(knots.time_s)
            bias = knots.gyro_bias.mean(axis=0)
            return check_few_prisms(
                observations,
                states,
                bias,
                samples,
                mounting,
                imu.noise,
                Gravity.of(imu),
                on_iteration=_WorkLimit(MAX_JOINT_ITERATIONS),
            )
        fit = fit_trajectory(
            observations,
            prior=parameters.pipeline.motion,
            noise_scale=1.0,
            rest=(),
            on_iteration=_WorkLimit(MAX_FIT_ITERATIONS),
        )
        return check_imu_setup(
            fit.observations,
            fit.trajectory,
            samples,
            mounting,
            imu.noise,
            Gravity.of(imu),
            on_iteration=_WorkLimit(MAX_JOINT_ITERATIONS),
        )
    except (
        GeometryError,
        np.linalg.LinAlgError,
    ):  # Too few measurements or samples: there is nothing to compare
        return SetupCheck()


class _WorkLimit:
    """Ends a search that takes more iterations than measurements without gross outliers need."""

    def __init__(self, iterations: int) -> None:
        self._left = iterations

    def __call__(self) -> None:
        if not self._left:
            raise GeometryError("the check of the IMU's set-up does not converge")
        self._left -= 1


class ImuSetupMonitor:
    """Monitors the set-up of an IMU that is configured; ``start``: how a check is computed."""

    def __init__(self, parameters: Parameters, start: StartCheck = start_now) -> None:
        self._parameters = parameters
        self._start = start
        self._measurements: deque[Measurement] = deque()
        self._records: deque[ImuSamples] = deque()
        self._next_ns: int | None = None
        self._result: Callable[[], SetupCheck] | None = None
        self._result_ns = 0
        self._watched_until_ns: int | None = None
        self._few_prisms = len(parameters.prisms) < MIN_PRISMS
        self._shocks = 0 if parameters.imu is None else parameters.imu.shocks_before
        self._shock_ns = -SHOCK_INTERVAL_NS
        self._standing: dict[Cause, SetupFinding] = {}
        self._confirmed = self._was_confirmed = False
        self._displaced = self._few_prisms and self._shocks > 0
        self._open = tuple(_PARTS.values())
        self._events: list[EventRecord] = []

    @property
    def untrusted(self) -> str | None:
        """Why the IMU must not be used: what is wrong in its set-up; None if nothing is known to be."""
        return "; ".join(each.text for each in self._standing.values()) or None

    @property
    def was_confirmed(self) -> bool:
        """Whether the drive has confirmed the set-up, after the newest shock."""
        return self._was_confirmed

    @property
    def shocks(self) -> int:
        """Number of shocks after which no drive has confirmed the set-up: each may have displaced the IMU."""
        return self._shocks

    @property
    def may_have_moved(self) -> bool:
        """Whether a set-up that was confirmed is wrong now in what a move of the IMU, a tripod or a prism changes."""
        return self._was_confirmed and not MOVE_CAUSES.isdisjoint(self._standing)

    @property
    def unconfirmed(self) -> str:
        """What the drive has not told of the set-up yet, for people; empty when it is confirmed."""
        return "" if self._confirmed else f"not confirmed by driving yet: {', '.join(self._open)}"

    @property
    def confirmed(self) -> bool:
        """Whether the drive has confirmed the set-up, and no later check has found it wrong."""
        return self._confirmed

    def take_events(self) -> Sequence[EventRecord]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def restart(self) -> None:
        """Confirm the set-up again, from what comes from now on: it may have changed."""
        self._measurements.clear()
        self._records.clear()
        self._next_ns = self._result = None
        self._confirmed = False
        self._open = tuple(_PARTS.values())

    def measurement(self, measurement: Measurement) -> None:
        """Take a measurement at its ``received_ns``."""
        now_ns = measurement.received_ns
        self._measurements.append(measurement)
        while self._measurements[0].received_ns < now_ns - WINDOW_NS:
            self._measurements.popleft()
        while self._records and self._records[0].received_ns < now_ns - WINDOW_NS - SILENT_NS:
            self._records.popleft()
        if self._next_ns is None:
            self._next_ns = now_ns + FIRST_NS
        if self._result is not None and now_ns >= self._result_ns:
            self._judge(self._result(), now_ns)
            self._result = None
        if self._result is None and now_ns >= self._next_ns:
            self._begin(now_ns)

    def samples(self, record: ImuSamples) -> None:
        """Take samples of the IMU at their ``received_ns``; after a shock the set-up is confirmed again.

        Fewer than three prisms confirm nothing any more then: they do not tell all rotations, and what they do not tell is not as
        configured for certain. Here, because lines that come late, or before the first measurement, reach no trajectory. They confirm
        again, too, after a time without samples; three prisms show at once what has changed.
        """
        watched_until_ns, self._watched_until_ns = self._watched_until_ns, record.stamp_ns[-1]
        begin_ns = record.stamp_ns[0] - record.duration_ns[0]
        unwatched = watched_until_ns is not None and begin_ns - watched_until_ns > UNWATCHED_NS
        _, shocks = judge_magnitudes(
            np.array(record.angular_rate_radps), np.array(record.specific_force_mps2)
        )
        if shocks.any():
            shocks_ns = np.array(record.stamp_ns)[shocks]
            self._shocks += abs(int(shocks_ns[0]) - self._shock_ns) > SHOCK_INTERVAL_NS
            self._shock_ns = int(shocks_ns[-1])
            self._displaced |= self._few_prisms
            self._was_confirmed = False
        if shocks.any() or (self._few_prisms and unwatched):
            self.restart()
        self._records.append(record)
        while self._records[0].received_ns < record.received_ns - WINDOW_NS:
            self._records.popleft()

    def _begin(self, now_ns: int) -> None:
        self._next_ns = now_ns + (INTERVAL_NS if self._confirmed else UNCONFIRMED_INTERVAL_NS)
        if not self._records:
            return
        parameters, measurements, records = self._parameters, tuple(self._measurements), tuple(self._records)
        self._result = self._start(lambda: check_recorded_setup(parameters, measurements, records))
        self._result_ns = now_ns + (RESULT_FEW_NS if self._few_prisms else RESULT_NS)

    def _judge(self, check: SetupCheck, now_ns: int) -> None:
        self._open = tuple(part for cause, part in _PARTS.items() if cause not in check.excluded)
        for cause in check.excluded & self._standing.keys():
            del self._standing[cause]
        for finding in check.findings:
            if finding.cause not in self._standing:
                has_moved = self._was_confirmed and finding.cause in MOVE_CAUSES
                message = f"{finding.text}; {_REMEDY_IF_MOVED if has_moved else _REMEDIES[finding.cause]}"
                self._events.append(EventRecord(stamp_ns=now_ns, event="imu_setup_wrong", message=message))
            self._standing[finding.cause] = finding
        if self._standing:
            self._confirmed = False
        elif not self._confirmed and check.confirmed and not self._displaced:
            self._confirmed = self._was_confirmed = True
            self._shocks = 0
            self._next_ns = now_ns + INTERVAL_NS
            message = _CONFIRMATION_BY_PRISMS.get(len(self._parameters.prisms), _CONFIRMATION)
            self._events.append(EventRecord(stamp_ns=now_ns, event="imu_setup_confirmed", message=message))
