"""Records that the master adds to the measurements on the stream: greeting, poses, status, events.

docs/reference/stream.md and configs/schema/stream.schema.json are generated from these classes and their
docstrings (``make generated``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

import tsgt
from tsgt.model import (
    MIN_PRISMS,
    ROBOT_FRAME,
    WORLD_FRAME,
    ClockSample,
    FiniteNumbers,
    Parameters,
    Row4,
    Status,
    Vector3,
    check_instants,
)

PROTOCOL_VERSION = 1

CAPABILITIES = ("setup", "measurement", "point", "pose", "clock", "beacon", "status", "event")

Kind = Literal["interpolated", "predicted", "smoothed"]
Reason = Literal[
    "", "outage", "station_status", "degenerate_geometry", "uncertain", "residual", "tilt", "contradicted"
]
Quality = Literal["good", "degraded", "invalid"]
Degradation = Literal[
    "prism_missing",
    "old_measurements",
    "uncertain",
    "ambiguous",
    "residual",
    "imu_unconfirmed",
    "imu_disagrees",
]
ImuUse = Literal["used", "starting", "silent", "disagrees", "wrong_setup", "unconfirmed"]
OdometryUse = Literal["used", "silent", "disagrees", "without_imu"]

CONTINUOUS_PROMISE = (
    "The sigmas that the pose states, of position at the reference point and of rotation, each in its least certain "
    "direction, are within the limits of its kind, and no measurement contradicts it."
)
FEW_PRISMS_PROMISE = (
    " With {prisms} and the IMU, no distances between three prisms check the set-up: a moved tripod or prism is noticed as far "
    "as the IMU contradicts it."
)
LINEAR_PROMISE = (
    "Every prism was measured before and after the pose within the outage limit, and their positions fit."
)

# Aliases, because pydantic evaluates annotations at run time.
PositionOrNone = Vector3 | None
QuaternionOrNone = Row4 | None
CovarianceOrNone = Annotated[tuple[float, ...], Field(min_length=36, max_length=36)] | None
ImuUseOrNone = ImuUse | None
OdometryUseOrNone = OdometryUse | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidityLimits(FiniteNumbers):
    """What ``valid`` promises of a pose, and the limits that are set in the configuration."""

    promise: str
    """The promise in one sentence."""
    reference_point: str
    """Name of the point whose position is judged: ``child_frame`` of the poses."""
    position_sigma_m: float | None
    """Limit of the sigma of the reference point's position in its least certain direction, in m; null: none, with the estimator linear."""
    rotation_sigma_rad: float | None
    """The same for the rotation, in rad."""
    predicted_position_sigma_m: float | None
    """The same of predicted poses, in m, at the reference point; null: none are sent."""
    predicted_rotation_sigma_rad: float | None
    """The same for the rotation, in rad."""
    residual_m: float
    """Limit of ``residual_m`` of the pose, in m."""
    tilt_rad: float
    """Limit of the angle between the robot's z axis and the vertical, in rad."""
    outage_s: float
    """A prism without measurements for longer, in s, is missing: poses of the estimator linear are then invalid."""

    @classmethod
    def of(cls, parameters: Parameters) -> ValidityLimits:
        """Return the limits of the parameters in force."""
        limits = parameters.pipeline
        continuous = limits.estimator == "continuous"
        promise = CONTINUOUS_PROMISE if continuous else LINEAR_PROMISE
        prisms = len(parameters.prisms)
        if prisms < MIN_PRISMS and parameters.imu is not None:
            promise += FEW_PRISMS_PROMISE.format(prisms=f"{prisms} prism{'' if prisms == 1 else 's'}")
        return cls(
            promise=promise,
            reference_point=parameters.reference_point.name,
            position_sigma_m=limits.position_sigma_limit_m if continuous else None,
            rotation_sigma_rad=limits.rotation_sigma_limit_rad if continuous else None,
            predicted_position_sigma_m=limits.predicted_position_sigma_limit_m if continuous else None,
            predicted_rotation_sigma_rad=limits.predicted_rotation_sigma_limit_rad if continuous else None,
            residual_m=limits.residual_limit_m,
            tilt_rad=limits.tilt_limit_rad,
            outage_s=limits.outage_limit_ns / 1e9,
        )


LimitsOrNone = ValidityLimits | None


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloRecord:
    """The first line that a reader gets."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"no_poses"})

    type: Literal["hello"] = "hello"
    protocol: int = PROTOCOL_VERSION
    """Version of the stream's format. It changes when a reader of the old version would misread the new one; new types
    of lines and new keys do not change it."""
    version: str = tsgt.__version__
    """Version of the software that serves the stream."""
    capabilities: tuple[str, ...] = CAPABILITIES
    """Types of lines that may follow."""
    limits: LimitsOrNone = None
    """What ``valid`` promises of a pose, with the limits in force; null where no poses follow."""
    no_poses: str | None = None
    """Why no poses follow until the set-up changes (``setup``): the master is not calibrated. Else absent."""

    @classmethod
    def of(cls, parameters: Parameters) -> HelloRecord:
        """Return the greeting of a master with these parameters."""
        if parameters.no_poses is not None:
            return cls(no_poses=parameters.no_poses)
        return cls(limits=ValidityLimits.of(parameters))


@dataclass(frozen=True, slots=True, kw_only=True)
class StationShare(FiniteNumbers):
    """The contribution of one station to a pose, or why there is none."""

    id: int
    """Number of the station, from 1; 0 while no station tracks the prism."""
    prism: int
    """Number of the prism that it tracks, from 1."""
    age_s: float | None
    """Age of the prism's last usable measurement at the pose, in s; null before the first one."""
    residual_m: float | None
    """Distance in m between the measured prism and the same prism of the fitted layout; null without a fit. Unless
    interpolated: median of three measurements near the pose."""
    reason: Reason
    """Why the prism has no position at the pose: ``outage`` or ``station_status``; empty when it has one. A pose that
    is not interpolated can be valid without it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseRecord(FiniteNumbers):
    """The pose of the robot at one epoch, or why there is none."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"delay_s", "imu", "jump_m", "jump_rad"})

    type: Literal["pose"] = "pose"
    stamp_ns: int
    """Time of the pose on the master's Unix clock in ns."""
    frame: str = WORLD_FRAME
    """Reference frame of the pose."""
    child_frame: str = ROBOT_FRAME
    """Frame whose pose it is."""
    position_m: PositionOrNone
    """Origin of ``child_frame`` in ``frame``, [x, y, z] in m; null when it cannot be computed."""
    orientation_xyzw: QuaternionOrNone
    """Rotation that takes coordinates in ``child_frame`` to ``frame``, as a Hamilton unit quaternion [x, y, z, w] with
    w >= 0; null when it cannot be computed."""
    covariance: CovarianceOrNone
    """Covariance of the pose, 6x6 row by row, order x, y, z (m), rotation about the fixed axes x, y, z (rad) of
    ``frame``; null when it cannot be computed."""
    covariance_common: CovarianceOrNone = None
    """The part of ``covariance`` that all poses share, in the same order: uncertainty of station frames and prisms,
    which does not average out over time. The rest is random. Null where the set-up's uncertainty is unknown."""
    velocity_mps: PositionOrNone
    """Velocity of the origin of ``child_frame``, [x, y, z] in m/s, in ``frame``; null when it cannot be computed."""
    angular_velocity_radps: PositionOrNone
    """Angular velocity [x, y, z] in rad/s, in ``child_frame``; null when it cannot be computed."""
    estimator: str
    """Name of the estimator."""
    kind: Kind
    """``interpolated`` between measurements (estimator ``linear``), ``predicted`` from earlier measurements, at once,
    or ``smoothed`` by measurements on both sides: at a delay, see ``delay_s``, or a lag later and final."""
    delay_s: float | None = None
    """Of a smoothed pose at one of the configured ``smoothed_delays_s``: that delay, in s, after which it was computed
    from the measurements that had arrived. The key is missing in all other poses. Without a measurement from after its
    epoch it has no numbers, because it would be a prediction."""
    imu: ImuUseOrNone = None
    """Whether the pose rests on the robot's IMU: ``used``; ``starting``: not yet, or not again, since its trajectory is not
    certain enough; ``silent``: no sample for 0.3 s; ``disagrees``: with the measurements of the prisms;
    ``wrong_setup``: a drive has shown that its mounting, latency, axes or units are wrong; ``unconfirmed``: no drive has
    shown that they are right since the start, the last set-up, shock or disagreement. With one or two stations such an IMU is
    ``used``, and ``degraded_by`` has ``imu_unconfirmed``. Poses without it are those of an estimator without IMU. The key is missing where no IMU is configured."""
    jump_m: float | None = None
    """Of a predicted pose with an IMU configured that is the first after measurements were added, or after the use of the
    IMU changed: distance in m from the position that would have been predicted before. The key is missing in all other
    poses."""
    jump_rad: float | None = None
    """The same for the rotation, in rad."""
    valid: bool
    """Whether the pose may be used. Invalid poses are sent too, with their reason."""
    reason: Reason
    """Why it is invalid: ``outage`` (a prism without measurements for too long), ``station_status`` (the instrument
    reported an error), ``degenerate_geometry`` (prisms collinear or coincident), ``residual`` (the prisms miss their
    layout by too much), ``uncertain`` (the pose is not known well enough, or nothing confirms it yet), ``tilt`` (the
    robot would lean too far: mirrored layout or swapped prisms), ``contradicted`` (with one or two stations, or while
    no more of three measure: the IMU has contradicted their measurements, or a single instrument was not level, so a tripod or prism
    may have moved; until the master is restarted or takes another set-up, or all three are measured). Empty when valid."""
    quality: Quality | None = None
    """``good``; ``degraded``: valid, but with less reserve, see ``degraded_by``; ``invalid``: not ``valid``. Null in
    recordings of older versions."""
    degraded_by: tuple[Degradation, ...] = ()
    """What degrades a valid pose: ``prism_missing`` (fewer than three prisms, or not all of one or two, are
    measured), ``old_measurements`` (a prediction whose newest measurement is older than three quarters of the outage limit), ``uncertain`` (a sigma is
    above half its limit), ``ambiguous`` (measurements contradicted each other up to 1.5 s before), ``residual``
    (``residual_m`` is above half its limit), ``imu_unconfirmed`` (it rests on an IMU whose set-up no drive has confirmed yet;
    the covariance allows for that), ``imu_disagrees`` (an IMU that was used disagrees with the prisms: it, a tripod or a prism may have
    moved; until the IMU is used again, or the master takes another set-up)."""
    residual_m: float | None
    """Root mean square over the prisms of their distance in m from the fitted layout; null without a fit."""
    stations: tuple[StationShare, ...]
    """One entry per prism of the layout: the station that tracks it."""

    @property
    def series(self) -> str:
        """Name of the poses that belong together, one per epoch: their kind, with their delay as in ``smoothed_1s``."""
        return self.kind if self.delay_s is None else f"{self.kind}_{self.delay_s:g}s"


LOW_BATTERY_PERCENT = 20
"""An instrument's battery with less is about to be empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StationStatus(FiniteNumbers):
    """The status of one station."""

    id: int
    """Number of the station, from 1."""
    measurements: int
    """Measurements received since the master started."""
    usable: int
    """How many of them could enter a pose."""
    age_s: float | None
    """Age of its last measurement in s; null before the first one."""
    status: Status | None
    """The instrument's status of its last measurement; null before the first one."""
    prism: int | None = None
    """Number of the prism that it reports to track; null before its first report, and while it tracks none."""
    locked: bool | None = None
    """Whether it had a target at its last measurement; null before the first one."""
    answering: bool | None = None
    """Whether it responded to the last request; null before the first one, false while the master's radio fails."""
    last_heard_s: float | None = None
    """Age of its last radio packet in s; null before the first one."""
    rate_hz: float | None = None
    """Distinct measurements per second over the last ten seconds; null before the first one."""
    loss: float | None = None
    """Share of the last fifty requests without a response, 0 to 1; null before the first request."""
    rssi_dbm: float | None = None
    """Signal strength of its last radio packet in dBm; null before the first one."""
    snr_db: float | None = None
    """Signal-to-noise ratio of its last radio packet in dB; null before the first one."""
    clock_offset_ns: int | None = None
    """Offset of its clock from the master's now, in ns, positive when the station is ahead; null before the first
    synchronisation, and with the protocol superframe, which has ``stamp_bound_ns``."""
    clock_bound_ns: int | None = None
    """The offset is within this of the truth, in ns; null like the offset."""
    stamp_bound_ns: int | None = None
    """The time of its newest measurement is within this of the truth, in ns; null before the first one."""
    joined: bool | None = None
    """Whether it has joined the present session of the master; null with the protocol classic."""
    outstanding: int | None = None
    """Measurements that were made but have not been received yet; null with the protocol classic."""
    drain_rate_hz: float | None = None
    """Decrease of ``outstanding`` per second over the last minute, negative while it grows; null before there are ten seconds,
    while it has not joined, and with the protocol classic."""
    drain_s: float | None = None
    """Time in s until none is outstanding, at that rate; null where it does not decrease."""
    missed_slots: int | None = None
    """Slots that stayed empty because its computer was late; null with the protocol classic."""
    rejected_beacons: int | None = None
    """Beacons that it received at impossible times, as in a delay attack; null with the protocol classic."""
    outside_lag_window: int | None = None
    """Measurements that arrived after the poses of their time had been smoothed; only post-processing uses them. Null
    with the estimator linear."""
    battery_percent: int | None = None
    """Charge of the instrument's battery in per cent; null where it does not report it, and with the protocol classic."""
    atmospheric_ppm: float | None = None
    """Atmospheric correction that the instrument applies to distances, in 1e-6, to 0.5 and from -127.5 to 127.5: the ends
    mean that or beyond. Null where it does not report it, and with the protocol classic."""
    activity: str | None = None
    """What the instrument does now, for people; empty where there is no word for it, null where unknown, and with the
    protocol classic."""
    problem: str | None = None
    """What requires the operator at the station, for people; empty where nothing does, null where unknown, and with the
    protocol classic."""
    last_target_check_age_s: float | None = None
    """Time in s since ``tsgt calibrate check`` last found the station where it was calibrated; null if it never has, or
    last found that it has moved."""

    @property
    def action_required(self) -> str:
        """What the operator has to do at the station although it may track, in words; empty for nothing."""
        if (
            not self.problem
            and self.battery_percent is not None
            and self.battery_percent < LOW_BATTERY_PERCENT
        ):
            return f"battery {self.battery_percent} %"
        return self.problem or ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuStatus(FiniteNumbers):
    """The status of the robot's IMU."""

    device: str
    """Maker, model and serial number, as its program reports them; empty before it has."""
    samples: int
    """Samples since the master started."""
    rate_hz: float | None
    """Samples per second over the last ten seconds; null without any."""
    age_s: float | None
    """Age of the newest sample in s; null before the first one."""
    gaps: int
    """How often samples were missing since the master started."""
    lost: int
    """How many samples were missing."""
    saturated: int
    """Samples with a value at the limit of the device."""
    clock_skew_ppm: float | None
    """Skew of this computer's clock against the device's, in 1e-6, positive when this one is fast; null before the first
    fit. Against a counter it also contains the error of the nominal rate."""
    problem: str
    """What is wrong with the device, its program or its values, for people; empty when nothing is."""
    use: ImuUseOrNone = None
    """Whether poses rest on it now, as in a pose; null where the estimator does not tell."""
    disagreement: str = ""
    """Why the estimator does not use its samples: how they disagree with the prisms, what is wrong in its set-up or not
    confirmed yet, for people; empty when it does."""
    gyro_bias_radps: PositionOrNone = None
    """Bias of the gyro now, as estimated, in its axes, [x, y, z] in rad/s; null while it is not."""
    accelerometer_bias_mps2: PositionOrNone = None
    """Bias of the accelerometer now, as estimated, in its axes, [x, y, z] in m/s^2; null while it is not."""

    def figures(self) -> list[str]:
        """Return rate, losses and clock, what is wrong, and what the estimator knows, each in words."""
        parts = [] if self.rate_hz is None else [f"{self.rate_hz:.1f} Hz"]
        parts += [f"{self.gaps} gaps ({self.lost} samples lost)", f"{self.saturated} saturated"]
        if self.clock_skew_ppm is not None:
            parts.append(f"clock {self.clock_skew_ppm:+.1f} ppm")
        if self.use is not None:
            parts.append(self.use)
        if self.gyro_bias_radps is not None:
            x, y, z = map(math.degrees, self.gyro_bias_radps)
            parts.append(f"gyro bias {x:+.3f} {y:+.3f} {z:+.3f} deg/s")
        if self.accelerometer_bias_mps2 is not None:
            x, y, z = self.accelerometer_bias_mps2
            parts.append(f"accelerometer bias {x:+.3f} {y:+.3f} {z:+.3f} m/s^2")
        return parts + [text for text in (self.problem, self.disagreement) if text]


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryStatus(FiniteNumbers):
    """The status of the robot's wheel odometry."""

    device: str
    """Maker, model and serial number, as its program reports them; empty before it has."""
    samples: int
    """Samples since the master started."""
    rate_hz: float | None
    """Samples per second over the last ten seconds; null without any."""
    age_s: float | None
    """Age of the newest sample in s; null before the first one."""
    gaps: int
    """How often samples were missing since the master started."""
    lost: int
    """How many samples were missing."""
    untrusted: int
    """Samples that the device did not trust."""
    clock_skew_ppm: float | None
    """Skew of this computer's clock against the device's, as for the IMU."""
    problem: str
    """What is wrong with the device or its program, for people; empty when nothing is."""
    use: OdometryUseOrNone = None
    """Whether poses rest on it now: ``used``; ``silent``: no sample for 1 s; ``disagrees``: with IMU and prisms, in most of the last
    seconds, so that it hardly counts; ``without_imu``: poses do not rest on the IMU, and wheels are used beside it. Null where the
    estimator does not tell."""
    scale: float | None = None
    """Estimated relative error of the speed that stays: the true speed is 1 + ``scale`` + ``slip`` times the measured one; null
    while it is not estimated."""
    scale_sigma: float | None = None
    """One sigma of it."""
    slip: float | None = None
    """Estimated relative error of the speed now, which comes and goes; null while it is not estimated."""
    slip_sigma: float | None = None
    """One sigma of it."""
    rejected: float | None = None
    """Share of the last four seconds of samples that contradict IMU and prisms, 0 to 1; null without samples there."""

    def figures(self) -> list[str]:
        """Return rate and losses, what is wrong, and what the estimator knows, each in words."""
        parts = [] if self.rate_hz is None else [f"{self.rate_hz:.1f} Hz"]
        parts.append(f"{self.gaps} gaps ({self.lost} samples lost)")
        if self.untrusted:
            parts.append(f"{self.untrusted} untrusted")
        if self.use is not None:
            parts.append(self.use.replace("_", " "))
        if self.scale is not None and self.scale_sigma is not None:
            parts.append(f"scale {100 * self.scale:+.2f} +/- {100 * self.scale_sigma:.2f} %")
        if self.slip is not None and self.slip_sigma is not None:
            parts.append(f"slip {100 * self.slip:+.1f} +/- {100 * self.slip_sigma:.1f} %")
        if self.rejected:
            parts.append(f"{100 * self.rejected:.0f} % rejected")
        return parts + ([self.problem] if self.problem else [])


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus(FiniteNumbers):
    """The status of the recording."""

    file: str
    """Its file name, as in ``setup``."""
    bytes: int
    """Its length in bytes."""
    last_write_ns: int | None
    """When the last lines were written, on the master's Unix clock in ns; null before the first ones."""
    waiting_lines: int
    """Lines that are not in the file yet; they pile up while the disk fails."""
    lost_lines: int
    """Lines that are lost because too many were waiting."""


LOW_DISK_BYTES = 1_000_000_000
"""Free space below which the disk is low: some hours of recording with an IMU."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiskStatus(FiniteNumbers):
    """The space on the disk of the recording."""

    free_bytes: int
    """Free for the master."""
    total_bytes: int
    """Its size."""


ImuStatusOrNone = ImuStatus | None
OdometryStatusOrNone = OdometryStatus | None
RecordingStatusOrNone = RecordingStatus | None
DiskStatusOrNone = DiskStatus | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusRecord(FiniteNumbers):
    """The status of the master and its stations, about once per second."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"imu", "odometry", "no_poses"})

    type: Literal["status"] = "status"
    stamp_ns: int
    """Time of the record on the master's Unix clock in ns."""
    poses: int
    """Predicted or interpolated poses, valid or not, since the master started: one per epoch."""
    valid_poses: int
    """How many of them were valid."""
    stations: tuple[StationStatus, ...]
    """One entry per station."""
    protocol: Literal["classic", "superframe"] | None = None
    """Name of the radio protocol: ``classic`` or ``superframe``; null without a radio, as in a replay."""
    authenticated: bool | None = None
    """Whether the radio is authenticated with a key; ``classic`` has none. Null without a radio."""
    frame_ms: float | None = None
    """Mean duration of the last frames, from beacon to beacon, in ms; null with ``classic``, and before the second beacon."""
    imu: ImuStatusOrNone = None
    """Status of the robot's IMU; absent where none is configured."""
    odometry: OdometryStatusOrNone = None
    """Status of the robot's wheel odometry; absent where none is configured."""
    recording: RecordingStatusOrNone = None
    """Status of the recording; null in recordings of older versions."""
    disk: DiskStatusOrNone = None
    """Space on its disk; null where unknown."""
    no_poses: str | None = None
    """Why no poses are computed: the master is not calibrated. Else absent."""

    def __post_init__(self) -> None:
        """Reject times outside 64 bits."""
        check_instants(self.stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockRecord(FiniteNumbers):
    """The result of a synchronisation with a station, with its raw samples."""

    type: Literal["clock"] = "clock"
    stamp_ns: int
    """When it was computed, on the master's Unix clock in ns."""
    station: int
    """Number of the station, from 1."""
    filter: str
    """Name of the filter: ``regression`` or ``paper``."""
    offset_ns: int
    """Offset of the station's clock from the master's at ``stamp_ns``, in ns; positive: the station is ahead."""
    frequency_ppm: float
    """Skew of the station's clock against the master's, in 1e-6; positive: the station's clock is fast. 0 where the
    filter does not estimate it."""
    sigma_ns: int
    """One sigma of the offset at ``stamp_ns``, in ns."""
    bound_ns: int
    """The offset at ``stamp_ns`` is within this of the truth, in ns."""
    restarted: bool
    """Whether earlier estimates were discarded: first synchronisation, restart, step."""
    samples: tuple[ClockSample, ...]
    """All samples of this synchronisation."""
    rejected: int
    """How many of them the filter rejected."""

    def __post_init__(self) -> None:
        """Reject times outside 64 bits."""
        check_instants(self.stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconRecord:
    """The transmission of a beacon of the protocol superframe.

    Stations journal its reception, which relates the times of measurements that only a journal has to the master's clock.
    """

    type: Literal["beacon"] = "beacon"
    stamp_ns: int
    """End of its transmission (TxDone) on the master's Unix clock in ns."""
    stamp_sigma_ns: int
    """One sigma of that, in ns; large where the radio's interrupt was lost."""
    session: int
    """Random number of the master's session."""
    counter: int
    """Number of the beacon in the session, from 0."""

    def __post_init__(self) -> None:
        """Reject times outside 64 bits."""
        check_instants(self.stamp_ns, self.stamp_sigma_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class EventRecord:
    """An event that a reader may want to act on."""

    type: Literal["event"] = "event"
    stamp_ns: int
    """When it was detected, on the master's Unix clock in ns."""
    event: str
    """Stable name of the event."""
    message: str
    """Description for people, one line."""
    station: int | None = None
    """Number of the station, from 1; null when it concerns none."""
    count: int | None = None
    """A number, for events that count something; else null."""

    def __post_init__(self) -> None:
        """Reject times outside 64 bits."""
        check_instants(self.stamp_ns)
