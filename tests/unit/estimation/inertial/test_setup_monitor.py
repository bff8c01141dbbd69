"""The set-up of the IMU is checked while the robot drives; what is wrong stands until a drive rules it out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import SECOND, START
from harness.inertial.imu_calibration import (
    calibrated_imu,
    imu_records,
    parameters_of,
    point_measurements,
    uncalibrated_drive,
)

from tsgt.errors import GeometryError
from tsgt.estimation import ImuSetupMonitor, check_recorded_setup
from tsgt.estimation.inertial import setup_monitor as imu_setup_monitor
from tsgt.geometry import exp_so3, quaternion_from_rotation, rotation_from_quaternion
from tsgt.geometry.inertial_calibration import SetupCheck, SetupFinding
from tsgt.model import ImuSamples, PointMeasurement

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial_calibration import Cause
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuParameters, Parameters
    from tsgt.recording import EventRecord

RIGHT = SetupCheck(
    excluded=frozenset({"axes", "rotation", "latency", "position", "unit_of_rate"}), confirmed=True
)
UNKNOWN = SetupCheck()


def wrong(cause: Cause) -> SetupCheck:
    """Return a check that finds one cause."""
    return SetupCheck((SetupFinding(cause, 0.02, 0.001, f"{cause} is wrong"),))


def shock(samples: ImuSamples) -> ImuSamples:
    """Return samples of which the last shows a knock: 90 m/s^2 along y."""
    return replace(samples, specific_force_mps2=(*samples.specific_force_mps2[:-1], (0.0, 90.0, 9.8)))


@dataclass
class Monitored:
    """A monitor whose checks give prepared results, fed for some time once a second."""

    checks: list[SetupCheck]
    seconds: int = 0
    prisms: int = 3
    shocks_before: int = 0

    def __post_init__(self) -> None:
        drive = uncalibrated_drive(1.0)
        self.samples, self.point = imu_records(drive)[0], point_measurements(drive)[0]
        parameters = parameters_of(drive, drive.imu)
        assert parameters.imu is not None
        imu = replace(parameters.imu, shocks_before=self.shocks_before)
        parameters = replace(parameters, prisms=parameters.prisms[: self.prisms], imu=imu)
        self.monitor = ImuSetupMonitor(parameters, start=self.start)

    def start(self, _work: Callable[[], SetupCheck]) -> Callable[[], SetupCheck]:
        """Give the next result."""
        check = self.checks.pop(0) if self.checks else UNKNOWN
        return lambda: check

    def run(self, seconds: int) -> list[EventRecord]:
        """Feed it."""
        for _ in range(seconds):
            now_ns = START + self.seconds * SECOND
            later_ns = now_ns - self.samples.stamp_ns[-1]
            stamps = tuple(each + later_ns for each in self.samples.stamp_ns)
            self.monitor.samples(replace(self.samples, received_ns=now_ns, stamp_ns=stamps))
            self.monitor.measurement(replace(self.point, received_ns=now_ns))
            self.seconds += 1
        return list(self.monitor.take_events())


def test_right_setup_is_confirmed_once() -> None:
    """The first check that tells confirms; further ones add nothing."""
    monitored = Monitored([UNKNOWN, RIGHT, RIGHT])
    assert monitored.run(18) == []
    assert not monitored.monitor.confirmed
    (event,) = monitored.run(40)
    assert (event.event, event.stamp_ns) == ("imu_setup_confirmed", START + 18 * SECOND)
    assert monitored.monitor.untrusted is None
    assert monitored.monitor.confirmed


def test_finding_stands_until_it_is_ruled_out() -> None:
    """A wrong set-up is reported once with what to do, and a drive that does not tell leaves it."""
    monitored = Monitored([wrong("rotation"), wrong("rotation"), UNKNOWN, RIGHT])
    (event,) = monitored.run(22)
    assert event.event == "imu_setup_wrong"
    assert event.message == "rotation is wrong; calibrate it: tsgt calibrate imu"
    assert event.stamp_ns == START + 14 * SECOND
    assert monitored.run(3) == []
    assert monitored.monitor.untrusted == "rotation is wrong"
    (event,) = monitored.run(30)
    assert event.event == "imu_setup_confirmed"
    assert monitored.monitor.untrusted is None


def test_knock_after_confirmation_is_reported() -> None:
    """A set-up that was right may become wrong, and each cause is named."""
    monitored = Monitored([RIGHT, wrong("rotation"), wrong("latency")])
    events = monitored.run(60)
    assert [each.event for each in events] == ["imu_setup_confirmed", "imu_setup_wrong", "imu_setup_wrong"]
    assert monitored.monitor.untrusted == "rotation is wrong; latency is wrong"
    assert not monitored.monitor.confirmed


@pytest.mark.parametrize("is_shock", [True, False])
def test_setup_that_becomes_wrong_without_a_shock_may_be_a_tripod(*, is_shock: bool) -> None:
    """A tripod that sinks tilts what the prisms tell, as if the IMU had turned."""
    monitored = Monitored([RIGHT, wrong("rotation")])
    monitored.run(20)
    if is_shock:
        monitored.monitor.samples(shock(monitored.samples))
    (event,) = monitored.run(40)
    assert ("a tripod or a prism has moved" in event.message) is not is_shock
    assert ("tsgt calibrate imu" in event.message) is is_shock
    assert monitored.monitor.may_have_moved is not is_shock


@pytest.mark.parametrize(("prisms", "confirmed"), [(3, True), (2, False), (1, False)])
def test_few_prisms_do_not_confirm_after_a_knock(prisms: int, *, confirmed: bool) -> None:
    """A drive does not show them all rotations by which the shock may have turned the IMU."""
    monitored = Monitored([RIGHT, RIGHT], prisms=prisms)
    monitored.run(22)
    assert monitored.monitor.confirmed
    monitored.monitor.samples(shock(monitored.samples))
    monitored.run(22)
    assert monitored.monitor.confirmed == confirmed


@pytest.mark.parametrize(("prisms", "confirmed"), [(3, True), (2, False), (1, False)])
def test_few_prisms_do_not_confirm_after_a_knock_before_them(prisms: int, *, confirmed: bool) -> None:
    """No measurement has come yet, so that no trajectory knows of the shock."""
    monitored = Monitored([RIGHT], prisms=prisms)
    monitored.monitor.samples(replace(shock(monitored.samples), received_ns=START - 10 * SECOND))
    monitored.run(22)
    assert monitored.monitor.confirmed == confirmed


@pytest.mark.parametrize(("prisms", "confirmed"), [(3, True), (2, False), (1, False)])
def test_few_prisms_do_not_confirm_after_shocks_of_an_earlier_master(prisms: int, *, confirmed: bool) -> None:
    """It has crashed, and this one knows of them."""
    monitored = Monitored([RIGHT], prisms=prisms, shocks_before=2)
    assert monitored.monitor.shocks == 2
    monitored.run(22)
    assert monitored.monitor.confirmed == confirmed
    assert monitored.monitor.shocks == (0 if confirmed else 2)


@pytest.mark.parametrize(("prisms", "shocks"), [(3, 0), (2, 3), (1, 3)])
def test_shocks_are_counted_until_a_drive_confirms(prisms: int, shocks: int) -> None:
    """Each may have displaced the IMU further; samples within a second are of one."""
    monitored = Monitored([RIGHT, RIGHT], prisms=prisms)
    monitored.run(22)
    for later_s in (0.0, 0.6, 1.2, 4.0, 8.0):
        later_ns = monitored.seconds * SECOND + int(later_s * SECOND)
        stamps = tuple(START + later_ns + 1_000_000 * k for k in range(len(monitored.samples.stamp_ns)))
        monitored.monitor.samples(replace(shock(monitored.samples), stamp_ns=stamps, received_ns=stamps[-1]))
    assert monitored.monitor.shocks == 3
    monitored.seconds += 8
    monitored.run(22)
    assert monitored.monitor.shocks == shocks


@pytest.mark.parametrize("prisms", [2, 1])
def test_few_prisms_confirm_anew_after_a_disagreement(prisms: int) -> None:
    """Whatever made the samples disagree, it was no shock."""
    monitored = Monitored([RIGHT, RIGHT], prisms=prisms)
    monitored.run(22)
    monitored.monitor.restart()
    assert not monitored.monitor.confirmed
    monitored.run(22)
    assert monitored.monitor.confirmed


@pytest.mark.parametrize(("prisms", "confirmed"), [(3, True), (2, False), (1, False)])
def test_few_prisms_confirm_anew_after_a_time_without_samples(prisms: int, *, confirmed: bool) -> None:
    """A knock in it shows no shock."""
    monitored = Monitored([RIGHT, RIGHT], prisms=prisms)
    monitored.run(22)
    monitored.seconds += 6
    monitored.run(1)
    assert monitored.monitor.confirmed == confirmed
    monitored.run(22)
    assert monitored.monitor.confirmed


def test_lost_imu_is_not_checked() -> None:
    """Its samples are from before all the measurements that are held."""
    monitored = Monitored([RIGHT])
    monitored.run(18)
    for _ in range(60):
        now_ns = START + monitored.seconds * SECOND
        monitored.monitor.measurement(replace(monitored.point, received_ns=now_ns))
        monitored.seconds += 1
    assert not monitored.monitor._records


@dataclass
class Setup:
    """A drive as it is configured and as its program gives the samples."""

    parameters: Parameters
    measurements: list[PointMeasurement]
    samples: list[ImuSamples]

    def events(self) -> list[EventRecord]:
        """Monitor the drive in the order of arrival."""
        monitor = ImuSetupMonitor(self.parameters)
        records: list[PointMeasurement | ImuSamples] = [*self.measurements, *self.samples]
        for record in sorted(records, key=lambda each: each.received_ns):
            if isinstance(record, ImuSamples):
                monitor.samples(record)
            else:
                monitor.measurement(record)
        return list(monitor.take_events())


@cache
def drive() -> Setup:
    """Drive for a minute with a calibrated IMU."""
    found = uncalibrated_drive(60.0, seed=5)
    parameters = parameters_of(found, calibrated_imu(found))
    return Setup(parameters, point_measurements(found), imu_records(found))


def sampled(rates: FloatArray, forces: FloatArray) -> Setup:
    """Return samples that are multiplied by matrices."""
    samples = [
        replace(
            each,
            angular_rate_radps=(np.array(each.angular_rate_radps) @ rates.T).tolist(),
            specific_force_mps2=(np.array(each.specific_force_mps2) @ forces.T).tolist(),
        )
        for each in drive().samples
    ]
    return replace(drive(), samples=samples)


def configured(change: Callable[[ImuParameters], ImuParameters]) -> Setup:
    """Return another configuration of the IMU."""
    imu = drive().parameters.imu
    assert imu is not None
    return replace(drive(), parameters=replace(drive().parameters, imu=change(imu)))


def turned(imu: ImuParameters, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> ImuParameters:
    """Turn the mounting by a degree, by default about the vertical."""
    rotation = exp_so3(np.radians(axis)) @ rotation_from_quaternion(np.array(imu.orientation_xyzw))
    x, y, z, w = quaternion_from_rotation(rotation).tolist()
    return replace(imu, orientation_xyzw=(x, y, z, w))


SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("prisms", [3, 2])
@pytest.mark.parametrize("measured", [True, False])
def test_nothing_to_compare(*, prisms: int, measured: bool) -> None:
    """Without a usable measurement, or without a sample that can be used, a check says nothing."""
    found = uncalibrated_drive(1.0)
    parameters = parameters_of(found, calibrated_imu(found))
    parameters = replace(parameters, prisms=parameters.prisms[:prisms])
    points = [replace(each, position_m=(1e9, 0.0, 0.0)) for each in point_measurements(found)]
    if measured:
        points = point_measurements(found)
    samples = [
        replace(each, specific_force_mps2=((1e6, 0.0, 0.0),) * len(each.stamp_ns)) if measured else each
        for each in imu_records(found)
    ]
    assert check_recorded_setup(parameters, points, samples) == SetupCheck()


@pytest.mark.parametrize("prisms", [3, 2])
def test_backlog_is_not_compared_without_its_samples(prisms: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements of times long before the samples that are held; two seconds do no harm."""
    compared: list[FloatArray] = []

    def fit(observations: Observations, *_: object, **__: object) -> None:
        compared.append(observations.time_s)
        raise GeometryError("not fitted here")

    monkeypatch.setattr(imu_setup_monitor, "fit_trajectory", fit)
    monkeypatch.setattr(imu_setup_monitor, "fit_inertial_trajectory", fit)
    found = uncalibrated_drive(20.0)
    parameters = parameters_of(found, calibrated_imu(found))
    parameters = replace(parameters, prisms=parameters.prisms[:prisms])
    points = point_measurements(found)
    samples = [each for each in imu_records(found) if each.stamp_ns[0] - points[0].stamp_ns > 5 * SECOND]
    assert check_recorded_setup(parameters, points, samples) == SetupCheck()
    (time_s,) = compared
    assert 3.0 <= time_s[0] < 3.6
    assert time_s[-1] > 19.0


@pytest.mark.parametrize("prisms", [2, 1])
def test_few_measurements_of_few_prisms_are_not_fitted(prisms: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """They do not tell the set-up, and a fit takes a third of a second."""

    def fit(*_: object, **__: object) -> None:
        pytest.fail("fitted")

    monkeypatch.setattr(imu_setup_monitor, "fit_inertial_trajectory", fit)
    found = uncalibrated_drive(8.0)
    parameters = parameters_of(found, calibrated_imu(found))
    parameters = replace(parameters, prisms=parameters.prisms[:prisms])
    points = [each for each in point_measurements(found) if each.station <= prisms][:59]
    assert check_recorded_setup(parameters, points, imu_records(found)) == SetupCheck()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setup", "message"),
    [
        (lambda: configured(turned), "the mounting of the IMU is wrong by"),
        (
            lambda: configured(lambda imu: replace(imu, position_m=(0.21, -0.02, 0.43))),
            "the position of the IMU is wrong by",
        ),
        (
            lambda: configured(lambda imu: replace(imu, latency_ns=14_300_000)),
            "the latency of the IMU is wrong",
        ),
        (lambda: sampled(SWAPPED, SWAPPED), "the axes of the IMU are swapped"),
        (lambda: sampled(np.eye(3) * 180 / np.pi, np.eye(3)), "degrees per second"),
        (lambda: sampled(np.eye(3), np.eye(3) / 9.81), "g instead of m/s^2"),
        (lambda: sampled(np.eye(3), -np.eye(3)), "the specific force has the wrong sign"),
    ],
)
def test_wrong_setup_is_noticed_within_a_minute(setup: Callable[[], Setup], message: str) -> None:
    """Each is one event with its cause."""
    (event,) = setup().events()
    assert event.event == "imu_setup_wrong"
    assert message in event.message


@pytest.mark.slow
@pytest.mark.parametrize("prism_numbers", [{1, 2}, {1, 2, 3}])
def test_prisms_of_another_robot_say_nothing_of_the_setup(prism_numbers: set[int]) -> None:
    """Followed in every other five seconds: a trajectory through them has false findings, and the search for it takes seconds."""

    def followed(measurement: PointMeasurement) -> PointMeasurement:
        at_s = (measurement.stamp_ns - drive().measurements[0].stamp_ns) / SECOND
        if measurement.prism not in prism_numbers or at_s % 10.0 >= 5.0:
            return measurement
        x, y, z = measurement.position_m
        return replace(measurement, position_m=(x + 4.0 + 0.5 * math.sin(at_s), y + 3.0, z + 0.2))

    measurements = [followed(each) for each in drive().measurements]
    assert check_recorded_setup(drive().parameters, measurements, drive().samples) == SetupCheck()


@pytest.mark.slow
def test_right_setup_of_a_drive_is_confirmed() -> None:
    """No false alarm."""
    assert [each.event for each in drive().events()] == ["imu_setup_confirmed"]


def checked(setup: Setup, prisms: int) -> SetupCheck:
    """Check a set-up by the measurements of some prisms."""
    parameters = replace(setup.parameters, prisms=setup.parameters.prisms[:prisms])
    stations = range(1, prisms + 1)
    return check_recorded_setup(
        parameters, [each for each in setup.measurements if each.station in stations], setup.samples
    )


@pytest.mark.slow
@pytest.mark.parametrize("prisms", [2, 1])
def test_few_prisms_confirm_a_right_setup(prisms: int) -> None:
    """As far as they tell it."""
    check = checked(drive(), prisms)
    assert not check.findings
    assert check.confirmed


@pytest.mark.slow
@pytest.mark.parametrize("prisms", [2, 1])
def test_few_prisms_tell_the_latency(prisms: int) -> None:
    """A clock that is 10 ms off is named."""
    setup = configured(lambda imu: replace(imu, latency_ns=imu.latency_ns + 10_000_000))
    (finding,) = checked(setup, prisms).findings
    assert finding.cause == "latency"


@pytest.mark.slow
def test_two_prisms_tell_a_rotation_but_about_their_line() -> None:
    """A degree about another axis is named, one about the line is not."""
    first, second = (np.array(each.position_m) for each in drive().parameters.prisms[:2])
    line = (second - first) / np.linalg.norm(second - first)
    across = np.cross(line, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(line, [0.0, 0.0, 1.0]))
    (finding,) = checked(configured(lambda imu: turned(imu, tuple(across))), 2).findings
    assert finding.cause == "rotation"
    assert finding.size == pytest.approx(np.radians(1.0), rel=0.2)
    assert "rotation" not in {
        each.cause for each in checked(configured(lambda imu: turned(imu, tuple(line))), 2).findings
    }
