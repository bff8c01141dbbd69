"""The robot's IMU in the smoothing of a recording: the fit with it, and where it is not to be used. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.estimation import (
    MAX_SHOCKS,
    SHOCK_INTERVAL_NS,
    UNWATCHED_NS,
    InertialSetupUncertainty,
    centroid_m,
    inertial_samples,
    wheel_samples,
)
from tsgt.geometry.batch import overall_scale, scale_noise
from tsgt.geometry.inertial import fit_inertial_trajectory, judge_magnitudes, usable_samples
from tsgt.geometry.trajectory import (
    AMBIGUITY_MARGIN_S,
    NOT_BY_CHANCE_NIS,
    OUTLIER_THRESHOLD,
    OWN_PRISM_M,
)
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialFit, InertialSamples
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuNoise, ImuSamples, OdometrySamples, Parameters

MAX_GAP_S = 0.5
"""Samples that are missing for longer are worse than the motion prior, which a pose without the IMU has instead."""

WINDOW_S = 10.0  # In which the measurements are compared with the trajectory
MAX_SQUARE = 9.0  # Of a normalised residual: one outlier does not condemn the IMU
MAX_MEAN_SQUARE = 2.5
"""Mean square of the normalised residuals, 1 if samples and measurements agree."""
MIN_COMPONENTS = 24  # Of residuals in a window: eight measurements
MAX_CONTRADICTED, MAX_CONTRADICTED_FEW = 0.5, 0.3
"""Share of the windows beyond which the IMU is not used at all, with three stations and with fewer. The measurements in a contradicted window
stay in the fit, and with one or two stations they displace the poses around it: where half of a drive of 80 s was contradicted, those of
the other half were 29 mm and 3 deg off.
"""

OUTAGE_S = 10.0
"""Without any measurement, after which those of a wrong prism agree with the trajectory: after 8 to 10 s those 1 m off did not."""

MAX_BIAS_SIGMAS = 8.0
"""Bias in sigmas of the data sheet. A mounting that is off by an angle passes for a bias of this angle times gravity."""

DISPLACEMENT_REMEDY = (
    "poses are degraded from then on, and their covariance allows for a turn by a degree; calibrate it again"
)

MOVED_REMEDY = "a tripod or prism may have moved, and the poses are {} from then on; check the stations (tsgt calibrate check)"

MIN_TOLD = 8  # Measurements of each of three prisms that tell what happened before them; of a prism alone that it is the right one
LONG_AFTER_S = 20.0
"""After an outage: measurements of a wrong prism have contradicted the IMU by then, if the robot turns."""

MOVED_SQUARE = 25.0  # Squared distance in sigmas of two successive measurements of one prism

NOISE_SCALE_PRIOR = 30.0
"""Components as many as the prior on a factor on the noise is worth; the factor 1 is that of the data sheet."""


EARLIER_SHOCK_S = 2.0 * SHOCK_INTERVAL_NS / 1e9
"""Shocks that masters before the recording measured are taken to be so long before it, and apart."""


@dataclass(frozen=True, slots=True)
class UnusedInterval:
    """A time in which the IMU was not used, in s on the time axis of the observations."""

    start_s: float
    end_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class ImuUse:
    """An IMU that was used in the smoothing of a recording."""

    stations: tuple[int, ...]  # whose measurements were used with it
    samples: InertialSamples
    fit: InertialFit
    noise_scales: FloatArray  # (S + 1, 3) factors on the stated noise of the measurements
    noise_scale: float  # Their root mean square over all measurements and components
    unused: tuple[UnusedInterval, ...]
    displaced_from_s: float = np.inf  # With fewer than three prisms: when a knock may have displaced it
    moved_from_s: float = np.inf  # When a tripod or prism seems to have moved
    shocks_s: FloatArray = field(
        default_factory=lambda: np.empty(0)
    )  # (N,) samples of shocks, in their order
    complete: bool = False  # Three prisms have poses without it, which are degraded where they contradict it, and else invalid
    odometry_samples: int = 0  # Of the wheel odometry that was used with it, while there were measurements

    def unused_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """(N,) whether the IMU is not to be used at times."""
        found = np.zeros(len(time_s), np.bool_)
        for each in self.unused:
            found |= (time_s >= each.start_s) & (time_s <= each.end_s)
        return found

    @property
    def first_shock_s(self) -> float:
        """When the first shock was; infinite without. What contradicts it from then on is no sign of a move."""
        return float(self.shocks_s.min(initial=np.inf))

    def shocks_before(self, time_s: FloatArray) -> NDArray[np.intp]:
        """(N,) number of shocks before times."""
        begins = np.diff(self.shocks_s, prepend=-np.inf) > SHOCK_INTERVAL_NS / 1e9
        return np.searchsorted(self.shocks_s[begins], time_s)

    def disagrees_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """(N,) whether it, a tripod or a prism may have moved at times, by measurements that contradict it without a shock."""
        found: NDArray[np.bool_] = time_s > self.moved_from_s
        for each in self.unused:
            if each.reason == "contradiction" and each.end_s < self.first_shock_s:
                found |= (time_s >= each.start_s) & (time_s <= each.end_s)
        return found

    @property
    def moved_remedy(self) -> str:
        """What :attr:`moved_from_s` means for the poses, and what to do."""
        return MOVED_REMEDY.format("degraded" if self.complete else "invalid")

    @property
    def unused_s(self) -> float:
        """Total time in which it was not used."""
        total_s, until_s = 0.0, -np.inf
        for each in sorted(self.unused, key=lambda each: each.start_s):
            total_s += max(each.end_s - max(each.start_s, until_s), 0.0)
            until_s = max(until_s, each.end_s)
        return total_s


def fit_with_imu(
    parameters: Parameters,
    observations: Observations,
    records: Iterable[ImuSamples],
    *,
    odometry: Sequence[OdometrySamples] = (),
    origin_ns: int,
    noise_scales: FloatArray,
    tuned: bool,
    on_progress: Callable[[float], None] | None = None,
) -> ImuUse:
    """Fit a trajectory to observations, with their stated noise, and to the samples of the IMU.

    ``noise_scales``: factors on the noise, (S + 1, 3); unless ``tuned`` they are estimated here. Raises GeometryError: the
    samples do not belong to the measurements or contradict them, or no trajectory fits.
    """
    imu = parameters.imu
    assert imu is not None  # noqa: S101 (the caller checks)
    recorded = inertial_samples(records, imu, origin_ns)
    samples = usable_samples(recorded, imu)
    start_s, end_s = float(observations.time_s[0]), float(observations.time_s[-1])
    if not len(samples) or samples.end_s[-1] < start_s or samples.end_s[0] > end_s:
        raise GeometryError(
            "the samples of the IMU do not overlap with the measurements in time; give those of this drive, or align their clock: "
            "tsgt import imu --align"
        )

    wheels, driven = None, 0
    if parameters.odometry is not None and odometry:
        speeds = wheel_samples(odometry, parameters.odometry, origin_ns)
        driven = int(np.count_nonzero((speeds.end_s >= start_s) & (speeds.end_s <= end_s)))
        wheels = (speeds, parameters.odometry) if driven else None

    def fitted(
        scales: FloatArray,
        setup: InertialSetupUncertainty = InertialSetupUncertainty(None, None),  # noqa: B008 (constant)
    ) -> InertialFit:
        return fit_inertial_trajectory(
            scale_noise(observations, scales),
            samples,
            imu,
            reference_m=centroid_m(parameters),
            odometry=wheels,
            setup_jacobian=setup.setup_jacobian,
            mounting_factor=setup.mounting_factor,
            on_progress=on_progress,
        )

    if not tuned:
        noise_scales = noise_scales * estimated_noise_scales(fitted(noise_scales))
    found = fitted(noise_scales, InertialSetupUncertainty.of(parameters))
    contradicted = contradicted_windows(found)
    windows = max((end_s - start_s) / WINDOW_S, 1.0)
    few_prisms = measured_prisms(observations) < MIN_PRISMS
    missing = gaps(samples, start_s, end_s)
    most = (MAX_CONTRADICTED_FEW if few_prisms else MAX_CONTRADICTED) * windows
    if len(contradicted) > max(most, 1.0):
        longest_s = max((each.end_s - each.start_s for each in missing), default=0.0)
        raise GeometryError(
            "the samples of the IMU contradict the measurements: its mounting, its latency or its axes are wrong, or it is loose "
            "(calibrate it: tsgt calibrate imu), or a tripod has moved (tsgt calibrate check)"
            + (
                f", or the rotation was lost in {longest_s:.1f} s without samples"
                if longest_s > OUTAGE_S
                else ""
            )
        )
    if few_prisms:
        contradicted = [
            replace(
                each,
                start_s=max(each.start_s - WINDOW_S / 2, start_s),
                end_s=min(each.end_s + WINDOW_S / 2, end_s),
            )
            for each in contradicted
        ]
    _check_biases(found, imu.noise)
    earlier_s = start_s - EARLIER_SHOCK_S * np.arange(min(imu.shocks_before, MAX_SHOCKS), 0, -1)
    shocks_s, moved_s = np.concatenate([earlier_s, shock_times_s(recorded)]), first_move_s(found)
    first_shock_s = float(shocks_s.min(initial=np.inf))
    complete = not few_prisms and np.isinf(first_untold_s(observations, moved_s))
    if complete and ((shocks_s > moved_s - LONG_AFTER_S) & (shocks_s < moved_s + WINDOW_S)).any():
        moved_s = np.inf  # The IMU was knocked
    numbers = [station.station for station in parameters.stations]
    return ImuUse(
        tuple(numbers[row] for row in np.unique(observations.station) if row < len(numbers)),
        samples,
        found,
        noise_scales,
        overall_scale(observations, noise_scales),
        (*missing, *contradicted, *unproven_intervals(found)),
        first_untold_s(observations, min(first_shock_s, first_unwatched_s(recorded, start_s))),
        moved_s,
        shocks_s,
        complete,
        driven,
    )


def measured_prisms(observations: Observations, from_s: float = -np.inf) -> int:
    """Return how many prisms were measured a few times, from a time on."""
    counts = np.bincount(observations.prism[observations.time_s > from_s])
    return int(np.count_nonzero(counts >= MIN_TOLD))


def first_untold_s(observations: Observations, from_s: float) -> float:
    """Return when something happened that three prisms would have told; infinite if they were measured from then on."""
    return np.inf if measured_prisms(observations, from_s) >= MIN_PRISMS else from_s


def first_move_s(fit: InertialFit) -> float:
    """Return when a station seems to have moved, by successive measurements of its prism that contradict the IMU; else infinite.

    Three prisms do not tell all of it: a tripod that sinks tilts the robot.

    The trajectory follows the station within two seconds, so that none is farther from it than :data:`OWN_PRISM_M`, as those
    of another prism are. A tripod moved by 20 mm gives 27 to 112, in one drive 22 and 34, which is not told from rain; one that has not
    moved gives 15 at most (imu_trust, seeds 13 and 14).
    """
    squares, time_s, prism = fit.squared_distances, fit.observations.time_s, fit.observations.prism
    own = np.linalg.norm(fit.residuals_m, axis=1) < OWN_PRISM_M
    found = np.inf
    for number in np.unique(prism):
        rows = np.flatnonzero((prism == number) & own)
        pairs = np.stack([squares[rows][:-1], squares[rows][1:]])
        pairs = (pairs.min(axis=0) > MOVED_SQUARE) & (pairs.max(axis=0) > NOT_BY_CHANCE_NIS)
        if pairs.any():
            found = min(found, float(time_s[rows][:-1][pairs][0]) - AMBIGUITY_MARGIN_S)
    # Soon after an outage those before may have been wrong already, and the poses of the outage rest on them.
    ended = np.flatnonzero(np.diff(time_s) > OUTAGE_S)
    recent = ended[
        (time_s[ended + 1] <= found + AMBIGUITY_MARGIN_S) & (found - time_s[ended + 1] < LONG_AFTER_S)
    ]
    return min(found, float(time_s[recent[0]])) if len(recent) else found


def unproven_intervals(fit: InertialFit) -> list[UnusedInterval]:
    """Return the intervals whose only measurements, between two outages of all prisms, may be of a wrong prism.

    Those of two prisms that agree are right, and so are :data:`MIN_TOLD` of one prism alone, because the robot turns meanwhile. Poses in
    the outages before and after rest on them, too.
    """
    time_s, prism = fit.observations.time_s, fit.observations.prism
    agrees = fit.squared_distances < OUTLIER_THRESHOLD**2
    starts = np.concatenate([[0], np.flatnonzero(np.diff(time_s) > OUTAGE_S) + 1, [len(time_s)]])
    found = []
    for first, stop in pairwise(starts.tolist()) if len(starts) > 2 else ():
        rows = slice(first, stop)
        counts = np.bincount(prism[rows][agrees[rows]])
        if np.count_nonzero(counts) < 2 and counts.sum() < MIN_TOLD:
            start_s, end_s = time_s[max(first - 1, 0)], time_s[min(stop, len(time_s) - 1)]
            found.append(UnusedInterval(float(start_s), float(end_s), "unproven"))
    return found


def first_unwatched_s(samples: InertialSamples, start_s: float) -> float:
    """Return when samples were first missing, after the start, for so long that a knock may not have been measured; infinite: never."""
    samples = samples.select(samples.end_s > start_s)
    missing_s = samples.end_s[1:] - samples.duration_s[1:] - samples.end_s[:-1]
    rows = np.flatnonzero(missing_s > UNWATCHED_NS / 1e9)
    return float(samples.end_s[rows[0]]) if len(rows) else np.inf


def shock_times_s(samples: InertialSamples) -> FloatArray:
    """Return when shocks were measured."""
    _, shocks = judge_magnitudes(samples.angular_rate_radps, samples.specific_force_mps2)
    return samples.end_s[shocks]


def _check_biases(fit: InertialFit, noise: ImuNoise) -> None:
    """Raise GeometryError if a bias is larger than such a device has."""
    knots = fit.trajectory.knots
    for name, biases, sigma, unit in (
        ("gyro", knots.gyro_bias, noise.gyro_bias_radps, "rad/s"),
        ("accelerometer", knots.bias_or_acceleration, noise.accelerometer_bias_mps2, "m/s^2"),
    ):
        bias = float(np.abs(np.median(biases, axis=0)).max())
        if bias > MAX_BIAS_SIGMAS * sigma:
            raise GeometryError(
                f"the samples of the IMU contradict the measurements, or its noise is not as configured: the bias of the {name} "
                f"would be {bias:.2g} {unit}, {bias / sigma:.0f} sigmas of its data sheet; check its mounting (tsgt calibrate imu)"
            )


def estimated_noise_scales(fit: InertialFit) -> FloatArray:
    """Factors on the noise of a fit by station and component, (S, 3), from its residuals and their expected squares.

    One step of the estimation of variance components (W. Foerstner, 1979), with a prior; outliers are left out.
    """
    observations = fit.observations
    squares, expected = (
        np.full((len(observations.frames), 3), NOISE_SCALE_PRIOR),
        np.full((len(observations.frames), 3), NOISE_SCALE_PRIOR),
    )
    variances = observations.sigmas_m**2
    known = np.isfinite(fit.residual_variances_m2) & (fit.weights == 1.0)[:, None]
    np.add.at(squares, observations.station, np.where(known, fit.residuals_m**2 / variances, 0.0))
    np.add.at(expected, observations.station, np.where(known, fit.residual_variances_m2 / variances, 0.0))
    scales: FloatArray = np.sqrt(squares / expected)
    return scales


def contradicted_windows(fit: InertialFit) -> list[UnusedInterval]:
    """Return the windows in which the measurements do not fit the trajectory with the IMU."""
    time_s = fit.observations.time_s
    squares = np.minimum(fit.residuals_m**2 / fit.residual_variances_m2, MAX_SQUARE)
    known = np.isfinite(squares)
    window = ((time_s - time_s[0]) // WINDOW_S).astype(np.int64)
    total = np.bincount(window, np.where(known, squares, 0.0).sum(axis=1))
    count = np.bincount(window, known.sum(axis=1))
    wrong = (count >= MIN_COMPONENTS) & (total > MAX_MEAN_SQUARE * count)
    starts_s = time_s[0] + WINDOW_S * np.flatnonzero(wrong)
    return [UnusedInterval(start_s, start_s + WINDOW_S, "contradiction") for start_s in starts_s.tolist()]


def gaps(samples: InertialSamples, start_s: float, end_s: float) -> list[UnusedInterval]:
    """Return the intervals between ``start_s`` and ``end_s`` without samples for longer than :data:`MAX_GAP_S`."""
    begins_s = np.append(samples.end_s - samples.duration_s, np.inf)
    ends_s = np.append(-np.inf, samples.end_s)
    rows = np.flatnonzero(np.minimum(begins_s, end_s) - np.maximum(ends_s, start_s) > MAX_GAP_S)
    return [
        UnusedInterval(float(max(ends_s[row], start_s)), float(min(begins_s[row], end_s)), "gap")
        for row in rows
    ]


def imu_keys(used: ImuUse | None, problem: str) -> dict[str, Any]:
    """Return for ``--json`` how the IMU was used; null where it was not, for a reason or without one."""
    if used is None:
        return {"imu": None} | ({"imu_problem": problem} if problem else {})
    return {
        "imu": {
            "stations": list(used.stations),
            "samples": len(used.samples),
            "unused_s": used.unused_s,
            **({"displaced_from_s": used.displaced_from_s} if np.isfinite(used.displaced_from_s) else {}),
            **({"moved_from_s": used.moved_from_s} if np.isfinite(used.moved_from_s) else {}),
            **({"odometry_samples": used.odometry_samples} if used.odometry_samples else {}),
            "tilt_sigma_mrad": 1e3 * used.fit.tilt_sigma_rad,
        }
    }
