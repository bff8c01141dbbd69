"""Selects the trajectory with the IMU while its samples are consistent with the prisms, otherwise the one without it. Sans-I/O.

Where three stations measure, the IMU is not used before the drive has confirmed its set-up.

Both are tracked all the time from the same measurements, the one without IMU twice a second while it is not needed. So when the
IMU falls silent, disagrees or turns out to be set up wrongly, the next poses are those of an estimator that never had one.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.estimation.inertial.samples import SampleConverter
from tsgt.estimation.inertial.wheels import WheelConverter
from tsgt.estimation.pose_batch import ImuUse
from tsgt.geometry.inertial import DISAGREES_WITH_PRISMS, SHOCK
from tsgt.geometry.trajectory import POSE_DIM
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from tsgt.estimation.inertial.setup_monitor import ImuSetupMonitor
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialFixedLagSmoother, WheelsEstimate
    from tsgt.geometry.trajectory import MeasurementWindow, Observations, States
    from tsgt.model import ImuParameters, ImuSamples, OdometryParameters, OdometrySamples, Vector3
    from tsgt.recording.stream_records import OdometryUse

SILENCE_S = 0.3
"""Without a sample for this long the IMU is silent. Lines of ten samples, held up by a computer under load, come sooner."""

ODOMETRY_SILENCE_S = 1.0
"""Without a sample for this long the wheel odometry is silent; nothing but the status depends on it."""

MAX_REJECTED_SHARE = 0.5
"""Share of the last seconds of wheel odometry, rejected one by one, above which it disagrees."""

RECOVERY_S = 1.0
"""How long a silent IMU must have delivered samples again before its trajectory is used."""

QUARANTINE_S, MAX_QUARANTINE_S = 4.0, 64.0
"""How long an IMU that disagreed must have been consistent: until the window holds nothing from before, and each time twice as long if it
disagrees again within :data:`PROVEN_S` of use. It stays as long where the samples have shown by themselves what was wrong and when that
had passed, and there are no poses without them.
"""
PROVEN_S = 60.0

CONTRADICTION_S = 0.4
"""How long measurements may contradict the trajectory with the IMU, and not the one without, until that is used. A single
wrong measurement contradicts for no longer: those of the other prisms follow.
"""

MAX_WITNESS_AGE_S = 1.0
"""Of the newest measurement, for the trajectory without IMU to tell that the one with it is wrong: in an outage no trajectory becomes
certain or is lost.
"""

NO_TRAJECTORY_S = 10.0
"""Three stations that had no trajectory for so long are not expected to have one soon."""

UNCONFIRMED_SIGMAS = np.repeat([0.005, np.radians(0.5)], 3)
"""Of the position in m and the rotation in rad by what an unconfirmed set-up may have wrong: a mounting 1 deg off moves poses by
0.35 deg rms, a lever arm 100 mm off or a latency 10 ms off by 2 mm and 0.2 deg (benchmarks/run.py imu_trust).
"""

MAX_SHOCKS = 4
"""Number of shocks that are allowed for at most: on rough ground there are many, which a good bracket withstands."""

_SIMULTANEOUS_S = 0.01  # Measurements of one prism are further apart

MAX_NIS, MAX_LASTING_NIS = 60.0, 30.0
"""Squared distance of the poses with IMU from those without, in sigmas of the latter, at once and in two checks half a second
apart. Six degrees of freedom exceed the second once in 25 000; predictions have longer tails.
"""

COMPARISON_INTERVAL_S = 0.5
COMPARED_AGE_S = 1.0  # Of smoothed poses that are compared

_KEPT_BEFORE_START_NS = 5_000_000_000  # of samples, before the first measurement


class OdometryState(NamedTuple):
    """What the estimator knows of the wheel odometry: whether poses rest on it, and its newest errors; None: not estimated."""

    use: OdometryUse
    wheels: WheelsEstimate | None


class ImuState(NamedTuple):
    """What the estimator knows of the IMU: whether poses rest on it, why it disagrees, and its biases as in the status."""

    use: ImuUse
    disagreement: str
    gyro_bias_radps: Vector3 | None
    accelerometer_bias_mps2: Vector3 | None
    odometry: OdometryState | None = None  # None without wheel odometry


_REJECTED_USES = ImuUse.DISAGREES, ImuUse.WRONG_SETUP


class ImuSelector:
    """The windows of the estimator ``continuous`` with an IMU, and which of them to use.

    ``without``, ``create_with``: the window without IMU, and what makes one with it, which starts from a number of prisms: the
    first, and another after each disagreement.
    ``setup``: monitors the set-up of the IMU; None: nothing does. ``prisms``: of the layout. ``use``: whether poses rest on the
    IMU, and why not. ``station_contradicted``: whether the IMU has contradicted one or two stations, and the trajectory follows them
    nevertheless, because nothing tells which of the two is wrong. ``disagrees``: whether an IMU that was used has turned out to disagree with
    the prisms, without a shock, and has not been used since: it, a tripod or a prism may have moved.
    """

    def __init__(
        self,
        imu: ImuParameters,
        without: MeasurementWindow,
        create_with: Callable[[int], InertialFixedLagSmoother],
        setup: ImuSetupMonitor | None = None,
        *,
        prisms: int = MIN_PRISMS,
        odometry: OdometryParameters | None = None,
    ) -> None:
        self._imu = imu
        self._without = without
        self._create_with = create_with
        self._setup, self._prisms = setup, prisms
        self._established = self.station_contradicted = self.disagrees = False
        # The trajectory with the IMU, since it was found
        self._was_consistent = self._was_ambiguous = False
        self._start_prisms = 1
        self._with = create_with(self._start_prisms)
        self._waiting: list[Observations] = []  # for the window without IMU
        self._converter: SampleConverter | None = None
        self._records: deque[ImuSamples] = deque()
        self._odometry = odometry
        self._wheels: WheelConverter | None = None
        self._driven: deque[OdometrySamples] = deque()
        self._now_s = self._driven_s = -np.inf  # Of the newest call, and of the newest sample of the wheels
        self._newest_s = self._usable_from_s = self._next_comparison_s = -np.inf
        self._contradicted_from_s = np.inf
        self._measured_s = -np.inf  # Newest measurement
        self._no_trajectory_from_s: float | None = None
        self._nis = (0.0, 0.0)  # of the predicted and of a smoothed pose
        self._contradiction = ""
        self._quarantine_s, self._used_from_s = 0.0, -np.inf
        self.use = ImuUse.STARTING
        self._disagreement = ""

    @property
    def window(self) -> MeasurementWindow:
        """The window whose trajectory is used."""
        return self._with if self.use == ImuUse.USED else self._without

    def state(self) -> ImuState:
        """Return what is known of the IMU now."""
        biases = self._with.biases if self._with.converged else None
        gyro, accelerometer = (None, None) if biases is None else biases
        disagreement = self._disagreement if self.use in _REJECTED_USES else ""
        if self.use == ImuUse.UNCONFIRMED and self._setup is not None:
            disagreement = self._setup.unconfirmed
        return ImuState(self.use, disagreement, _vector(gyro), _vector(accelerometer), self._odometry_state())

    def _odometry_state(self) -> OdometryState | None:
        if self._odometry is None:
            return None
        wheels = self._with.wheels if self._with.converged else None
        use: OdometryUse = "used"
        if not self._now_s - self._driven_s <= ODOMETRY_SILENCE_S:  # Also before the first sample
            use = "silent"
        elif self.use != ImuUse.USED:
            use = "without_imu"
        elif wheels is not None and (wheels.rejected_share or 0.0) > MAX_REJECTED_SHARE:
            use = "disagrees"
        return OdometryState(use, wheels)

    @property
    def horizon_s(self) -> float:
        """Start of the window without IMU: earlier measurements are rejected, as if there were no IMU."""
        return self._without.horizon_s

    @property
    def held(self) -> int:
        """How many measurements the earlier window holds, which may be the next to be used."""
        waiting = sum(len(each) for each in self._waiting)
        return max(len(self._with.residuals_m), len(self._without.residuals_m) + waiting)

    def begin(self, origin_ns: int) -> None:
        """Fix the time origin of the observations."""
        self._converter = SampleConverter(self._imu, origin_ns)
        if self._odometry is not None:
            self._wheels = WheelConverter(self._odometry, origin_ns)

    def add_samples(self, record: ImuSamples) -> None:
        """Take samples; before the first measurement only the newest are kept."""
        self._records.append(record)
        while (
            self._converter is None
            and self._records[0].received_ns < record.received_ns - _KEPT_BEFORE_START_NS
        ):
            self._records.popleft()

    def add_odometry(self, record: OdometrySamples) -> None:
        """Take samples of the wheel odometry; before the first measurement only the newest are kept."""
        self._driven.append(record)
        while (
            self._wheels is None and self._driven[0].received_ns < record.received_ns - _KEPT_BEFORE_START_NS
        ):
            self._driven.popleft()

    def take_samples(self) -> None:
        """Use the samples that were added."""
        if self._wheels is not None and self._driven:
            wheels = self._wheels.convert(self._driven)
            self._with.add_odometry(wheels)
            self._driven_s = float(wheels.end_s[-1]) if len(wheels) else self._driven_s
            self._driven.clear()
        if self._converter is None or not self._records:
            return
        samples = self._converter.convert(self._records)
        self._records.clear()
        if len(samples):
            self._newest_s = float(samples.end_s[-1])
            self._with.add_samples(samples)

    def update(self, new: Observations) -> None:
        """Process measurements, in the order of time."""
        self._measured_s = max(self._measured_s, float(new.time_s[-1]))
        # A window that replaces another starts with the samples since; measurements from before still arrive.
        within = new.time_s >= self._with.horizon_s
        if within.any():
            self._with.update(new if within.all() else new.select(within))
        self._waiting.append(new)
        if self.use != ImuUse.USED:
            self._update_without()

    def choose(self, now_s: float) -> None:
        """Choose the window for poses that are sent at a time."""
        self._now_s = now_s
        if self._without.converged or self._no_trajectory_from_s is None:
            self._no_trajectory_from_s = now_s
        if self.use == ImuUse.USED and now_s >= self._next_comparison_s:
            self._next_comparison_s = now_s + COMPARISON_INTERVAL_S
            self._compare(now_s)
        found = self._found(now_s)
        self._watch_stations(found)
        if found in _REJECTED_USES:
            self._disagreement = self._untrusted or self._contradiction
            # What the samples show by themselves passes; whatever else it was may have come to stay.
            uncertain = bool(self._with.setup_doubt) or self._with.health is None
            if found == ImuUse.DISAGREES and uncertain and self._setup is not None:
                self._setup.restart()
            if self.use == ImuUse.USED:
                self.disagrees |= self._may_have_moved(found, uncertain=uncertain)
                again = now_s - self._used_from_s < PROVEN_S
                # With fewer than three prisms there are no poses meanwhile.
                longer = 2 if uncertain or self._prisms >= MIN_PRISMS else 1
                self._quarantine_s = min(longer * self._quarantine_s, MAX_QUARANTINE_S) if again else 0.0
            self._contradicted_from_s, self._nis, self._contradiction = np.inf, (0.0, 0.0), ""
            # A prism measured alone, of several, may be the wrong one, with which a right IMU disagreed.
            if uncertain:
                self._start_prisms = min(2, self._prisms)
            elif self._with.converged:
                self._start_prisms = 1
            self._with = self._create_with(self._start_prisms)
            self._was_consistent = self._was_ambiguous = False
            self._quarantine_s = max(self._quarantine_s, QUARANTINE_S)
            self._usable_from_s = now_s + self._quarantine_s
        elif found == ImuUse.SILENT:
            self._usable_from_s = max(self._usable_from_s, now_s + RECOVERY_S)
        elif now_s < self._usable_from_s:
            found = self.use
        if found != ImuUse.USED:
            self._update_without()
        elif self.use != ImuUse.USED:
            self._used_from_s = now_s
            self.disagrees = False
        self.use = found

    def marginalise_before(self, before_s: float) -> None:
        """Marginalise the states before a time."""
        self._update_without()
        self._without.marginalise_before(before_s)
        self._with.marginalise_before(before_s)

    def contradict(self) -> None:
        """Note that a single station has moved, as its instrument says."""
        self.station_contradicted |= self._established

    def _watch_stations(self, found: ImuUse) -> None:
        """Note whether measurements of one or two prisms contradicted the IMU, and are followed from then on.

        A wrong one among right ones is an outlier, which is not followed. One alone that is followed is within what is possible: a
        station that has moved contradicts with the next one too. A trajectory that was never consistent may itself be wrong. With a
        single prism a trajectory that is lost in a contradiction, or given up for another fault, starts again where the station then is.
        Three stations of which fewer are measured are no better, until the trajectory without IMU tells.
        """
        disagrees = found == ImuUse.DISAGREES
        rejected = disagrees and DISAGREES_WITH_PRISMS in self._contradiction
        if self._was_consistent:
            rejected |= self._with.lost_after_s > _SIMULTANEOUS_S
            rejected |= disagrees and self._with.beyond_chance
        rejected &= self._prisms == 1
        followed = False
        if not self._with.converged:
            self._was_consistent = self._was_ambiguous = False
        elif self._with.ambiguous:
            self._was_ambiguous = self._was_consistent
        else:
            # One in a thousand is inconsistent by chance, and no other.
            followed = self._was_ambiguous and self._with.followed_for_s > _SIMULTANEOUS_S
            self._was_consistent, self._was_ambiguous = True, False
        if self._with.measured_prisms < MIN_PRISMS:
            self.station_contradicted |= self._established and (followed or rejected)
        elif self._without.converged:
            self.station_contradicted = False
        self._established |= self._with.converged and not self._with.ambiguous

    @property
    def _untrusted(self) -> str | None:
        return None if self._setup is None else self._setup.untrusted

    def _may_have_moved(self, found: ImuUse, *, uncertain: bool) -> bool:
        """Whether an IMU that is rejected, a tripod or a prism may have moved: it was right before, and there was no shock."""
        if found == ImuUse.WRONG_SETUP:
            return self._setup is not None and self._setup.may_have_moved
        was_right = self._setup is None or self._setup.was_confirmed
        return uncertain and was_right and self._with.setup_doubt != SHOCK

    def _found(self, now_s: float) -> ImuUse:
        if self._untrusted is not None:
            return ImuUse.WRONG_SETUP
        # What the samples showed before they ended counts, too.
        if now_s - self._newest_s > SILENCE_S and not self._with.setup_doubt:
            return ImuUse.SILENT if np.isfinite(self._newest_s) else ImuUse.STARTING
        if self._contradicted(now_s):
            return ImuUse.DISAGREES
        if not self._with.converged:
            return ImuUse.STARTING
        return ImuUse.UNCONFIRMED if self._unconfirmed(now_s) else ImuUse.USED

    def _unconfirmed(self, now_s: float) -> bool:
        """Whether the IMU is not to be used yet. Where no three prisms are measured there is nothing else."""
        if self._setup is None or self._setup.confirmed:
            return False
        assert self._no_trajectory_from_s is not None  # noqa: S101 (choose sets it)
        return now_s - self._no_trajectory_from_s < (NO_TRAJECTORY_S if self._prisms >= MIN_PRISMS else 0.0)

    @property
    def shocks(self) -> int:
        """Number of shocks after which no drive has confirmed the set-up."""
        return 0 if self._setup is None else self._setup.shocks

    @property
    def unconfirmed(self) -> bool:
        """Whether poses rest on the IMU, though no drive has confirmed its set-up."""
        return self.use == ImuUse.USED and self._setup is not None and not self._setup.confirmed

    def _contradicted(self, now_s: float) -> bool:
        """Whether the IMU is rejected, or the trajectory with it has diverged while the one without has converged."""
        self._contradiction = self._contradiction or self._with.setup_doubt or self._with.health or ""
        if self._contradiction:
            return True
        consistent = self._with.converged and not self._with.ambiguous
        if self.use != ImuUse.USED or consistent or now_s - self._measured_s > MAX_WITNESS_AGE_S:
            self._contradicted_from_s = np.inf
            return False
        self._contradicted_from_s = min(self._contradicted_from_s, now_s)
        if self._with.converged and now_s - self._contradicted_from_s < CONTRADICTION_S:
            return False
        self._update_without()
        if not self._without.converged or self._without.ambiguous:
            return False
        self._contradiction = "the measurements of the prisms contradict it"
        return True

    def _compare(self, now_s: float) -> None:
        """Compare predicted and smoothed poses of both; the covariance without IMU also follows from such predictions."""
        self._update_without()
        if not self._with.converged or not self._without.converged or self._without.ambiguous:
            return
        predicted = _nis(
            *self._with.predict(now_s, dim=POSE_DIM), *self._without.predict(now_s, dim=POSE_DIM)
        )
        then_s = np.array([now_s - COMPARED_AGE_S])
        smoothed = 0.0
        if then_s[0] > max(each.reliable_from_s for each in (self._with, self._without)):
            both = (each.trajectory().at(then_s, dim=POSE_DIM) for each in (self._with, self._without))
            smoothed = _nis(*next(both), *next(both))
        found = (predicted, smoothed)
        lasting = (min(pair) for pair in zip(found, self._nis, strict=True))
        if max(found) > MAX_NIS or max(lasting) > MAX_LASTING_NIS:
            self._contradiction = f"its poses are {max(found) ** 0.5:.1f} sigmas from those without it"
        self._nis = found

    def _update_without(self) -> None:
        for each in self._waiting:
            self._without.update(each)
        self._waiting.clear()


def unconfirmed_covariance(shocks: ArrayLike) -> FloatArray:
    """Return what an unconfirmed set-up adds to the covariance of a pose, (..., 6, 6), by the number of shocks before it, (...)."""
    counted = np.clip(shocks, 1, MAX_SHOCKS)
    return np.asarray(counted[..., None, None] * np.diag(UNCONFIRMED_SIGMAS**2))


def _nis(state: States, _: FloatArray, other: States, covariance: FloatArray) -> float:
    """Squared distance of a pose from another, in sigmas of the latter."""
    error = state.local_coordinates_about(other)[0, :POSE_DIM]
    return float(error @ np.linalg.solve(covariance[0], error))


def _vector(values: FloatArray | None) -> Vector3 | None:
    if values is None:
        return None
    x, y, z = values.tolist()
    return x, y, z
