"""One record of every type."""

from __future__ import annotations

from tsgt.config import IMU_NOISE
from tsgt.model import (
    ClockSample,
    ImuParameters,
    ImuSamples,
    Parameters,
    PointMeasurement,
    PolarMeasurement,
    PrismPosition,
    StationParameters,
    Status,
)
from tsgt.recording import (
    ClockRecord,
    EventRecord,
    HelloRecord,
    ImuStatus,
    OdometryStatus,
    PoseRecord,
    RecordingHeader,
    SetupGeofence,
    SetupRecord,
    StationShare,
    StationStatus,
    StatusRecord,
    encode_line,
)

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND

HELLO = HelloRecord()
HEADER = RecordingHeader(software="tsgt test", created_ns=START, source="test")
PARAMETERS = Parameters(
    stations=tuple(StationParameters(station=number, prism=number) for number in (1, 2, 3)),
    prisms=tuple(
        PrismPosition(prism=number, position_m=position)
        for number, position in ((1, (-0.5, 0.0, 1.0)), (2, (0.5, 0.0, 1.0)), (3, (0.0, 0.5, 1.5)))
    ),
)
SETUP = SetupRecord.of(
    PARAMETERS,
    START,
    protocol="superframe",
    authenticated=True,
    geofences=[
        SetupGeofence(
            name="site", allowed_side="inside", polygon_m=((0.0, 0.0), (50.0, 0.0), (0.0, 50.0)), margin_m=1.0
        )
    ],
    recording="master-20261121T055100Z.jsonl",
)
POINT = PointMeasurement(
    station=2, prism=2, sequence=0, stamp_ns=START, received_ns=START + SECOND, position_m=(1.0, -2.5, 1 / 3)
)
POSE = PoseRecord(
    stamp_ns=START + 50_000_000,
    position_m=(1.0, 2.0, -0.1),
    orientation_xyzw=(0.0, 0.0, 0.6, 0.8),
    covariance=tuple(1e-6 if row == column else 0.0 for row in range(6) for column in range(6)),
    velocity_mps=(1.0, 0.0, 0.0),
    angular_velocity_radps=(0.0, 0.0, 0.1),
    estimator="linear",
    kind="interpolated",
    valid=True,
    reason="",
    residual_m=0.0021,
    stations=(StationShare(id=1, prism=1, age_s=0.25, residual_m=0.001, reason=""),),
)
NO_POSE = PoseRecord(
    stamp_ns=START + 100_000_000,
    position_m=None,
    orientation_xyzw=None,
    covariance=None,
    velocity_mps=None,
    angular_velocity_radps=None,
    estimator="linear",
    kind="interpolated",
    valid=False,
    reason="outage",
    residual_m=None,
    stations=(StationShare(id=1, prism=1, age_s=None, residual_m=None, reason="outage"),),
)
STATUS = StatusRecord(
    stamp_ns=START + 2 * SECOND,
    poses=20,
    valid_poses=19,
    stations=(
        StationStatus(id=1, measurements=5, usable=4, age_s=0.2, status=Status.OK),
        StationStatus(id=2, measurements=0, usable=0, age_s=None, status=None),
    ),
)
CLOCK = ClockRecord(
    stamp_ns=START + 2 * SECOND,
    station=2,
    filter="regression",
    offset_ns=-7_200_000_123_456,
    frequency_ppm=9.7,
    sigma_ns=25_000,
    bound_ns=310_000,
    restarted=True,
    samples=(
        ClockSample(
            sent_ns=START + SECOND,
            station_ns=START - 7199 * SECOND,
            received_ns=START + SECOND + 111_000_000,
            forward_ns=55_300_000,
            back_ns=55_300_000,
        ),
    ),
    rejected=0,
)
EVENT = EventRecord(stamp_ns=START + 3 * SECOND, event="lines_lost", message="lost 7 lines", count=7)


def measurement(sequence: int) -> PolarMeasurement:
    """Return one of a sequence of measurements, 0.4 s apart."""
    stamp_ns = START + sequence * 400_000_000
    return PolarMeasurement(
        station=1,
        prism=1,
        sequence=sequence,
        stamp_ns=stamp_ns,
        received_ns=stamp_ns + 100_000_000,
        horizontal_angle_rad=0.1 + sequence / 7,
        zenith_angle_rad=1.5,
        slope_distance_m=30.0 + sequence / 3,
        host_time_ns=stamp_ns,
    )


IMU_PARAMETERS = ImuParameters(
    position_m=(0.1, 0.0, 0.5),
    orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
    noise=IMU_NOISE["industrial"],
)
IMU_STATUS = ImuStatus(
    device="Acme 7",
    samples=2000,
    rate_hz=199.9,
    age_s=0.04,
    gaps=1,
    lost=3,
    saturated=0,
    clock_skew_ppm=-12.5,
    problem="",
)


ODOMETRY_STATUS = OdometryStatus(
    device="Acme base",
    samples=400,
    rate_hz=20.0,
    age_s=0.08,
    gaps=1,
    lost=2,
    untrusted=3,
    clock_skew_ppm=None,
    problem="",
    use="used",
    scale=0.0125,
    scale_sigma=0.002,
    slip=-0.021,
    slip_sigma=0.012,
    rejected=0.25,
)


def imu_samples(sequence: int, count: int = 10) -> ImuSamples:
    """Return samples of an IMU at rest, 5 ms apart."""
    stamps = tuple(START + (sequence + i) * 5_000_000 for i in range(count))
    return ImuSamples(
        sequence=sequence,
        received_ns=stamps[-1] + 1_000_000,
        stamp_ns=stamps,
        duration_ns=(5_000_000,) * count,
        instrument_time_ns=None,
        angular_rate_radps=tuple((1e-6 * i, 0.0, 0.1) for i in range(count)),
        specific_force_mps2=((0.0, 0.0, 9.81),) * count,
    )


def recording_bytes(*records: object) -> bytes:
    """Return a file with header, parameters and records."""
    return b"".join(encode_line(record) + b"\n" for record in (HEADER, PARAMETERS, *records))
