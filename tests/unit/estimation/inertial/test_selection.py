"""The estimator ``continuous`` with an IMU: which trajectory poses rest on, and the order of records."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, Scene, driving, stationary_scene
from harness.files.records import IMU_PARAMETERS, imu_samples

from tsgt.estimation import LiveEstimator
from tsgt.estimation.continuous import ContinuousEstimator
from tsgt.estimation.inertial import setup_monitor as imu_setup_monitor
from tsgt.estimation.inertial.selection import (
    NO_TRAJECTORY_S,
    PROVEN_S,
    QUARANTINE_S,
    RECOVERY_S,
    SILENCE_S,
    ImuSelector,
    ImuState,
)
from tsgt.estimation.pose_batch import ImuUse
from tsgt.geometry.inertial import SHOCK, WheelsEstimate
from tsgt.geometry.inertial_calibration import SetupCheck, SetupFinding
from tsgt.geometry.trajectory import FixedLagSmoother
from tsgt.model import ImuSamples, Measurement, OdometryParameters, OdometrySamples, Status
from tsgt.recording import PoseRecord, encode_line

if TYPE_CHECKING:
    from tsgt.geometry.inertial import InertialSamples, SaturationMonitor, WheelSamples
    from tsgt.model import ImuParameters, MotionPrior

LINE_S = 0.05
UP_M = 0.02
RIGHT = SetupCheck(confirmed=True)


class FakeInertialSmoother(FixedLagSmoother):
    """A smoother without IMU in the place of one with: its poses are ``up_m`` higher."""

    created: ClassVar[list[FakeInertialSmoother]] = []

    def __init__(
        self, _imu: ImuParameters, prior: MotionPrior, *, saturation: SaturationMonitor, **_: Any
    ) -> None:
        super().__init__(prior)
        self.saturation = saturation
        self.up_m = UP_M
        self.health: str | None = None
        self.setup_doubt = ""
        self.contradicted = False
        self.wheels: WheelsEstimate | None = None
        self.biases = np.array([0.001, 0.002, -0.003]), np.array([0.01, -0.02, 0.03])
        self.samples: list[InertialSamples] = []
        self.created.append(self)

    def add_samples(self, samples: InertialSamples) -> None:
        """Keep samples."""
        self.samples.append(samples)

    def add_odometry(self, _: WheelSamples) -> None:
        """Use none."""

    def predict(self, time_s: float, *, dim: int = 18) -> Any:
        """Predict as without IMU, but higher."""
        state, covariance = super().predict(time_s, dim=dim)
        return replace(state, position=state.position + [0.0, 0.0, self.up_m]), covariance  # noqa: RUF005

    @property
    def ambiguous(self) -> bool:
        """Whether measurements contradict it."""
        return self.contradicted or super().ambiguous


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Three stations, a robot that drives a bend, and an IMU."""
    FakeInertialSmoother.created.clear()
    monkeypatch.setattr("tsgt.estimation.continuous.InertialFixedLagSmoother", FakeInertialSmoother)
    monkeypatch.setattr(imu_setup_monitor, "FIRST_NS", 0)
    monkeypatch.setattr(imu_setup_monitor, "RESULT_NS", 0)
    monkeypatch.setattr(imu_setup_monitor, "RESULT_FEW_NS", 0)
    monkeypatch.setattr(imu_setup_monitor, "UNCONFIRMED_INTERVAL_NS", SECOND // 2)
    scene = stationary_scene().moving(driving).with_limits(estimator="continuous", period_ns=100_000_000)
    return replace(scene, parameters=replace(scene.parameters, imu=IMU_PARAMETERS))


def arrivals(
    scene: Scene, until_s: float, silent: tuple[float, float] = (np.inf, np.inf)
) -> list[Measurement | ImuSamples]:
    """Measurements of the stations in turn and lines of the IMU, but for a time without, in the order of arrival."""
    found: list[Measurement | ImuSamples] = [
        replace(scene.measure(station, time_s + 0.1 * station), sequence=number)
        for number, time_s in enumerate(np.arange(0.0, until_s, 0.4).tolist())
        for station in (1, 2, 3)
    ]
    for line in range(round(until_s / LINE_S)):
        record = imu_samples(10 * line)
        if not silent[0] <= line * LINE_S < silent[1]:
            found.append(record)
    found = [each for each in found if each.received_ns <= START + until_s * SECOND]
    return sorted(found, key=lambda each: each.received_ns)


def checked(scene: Scene, check: SetupCheck = RIGHT) -> LiveEstimator:
    """Return a live estimator whose checks of the set-up give one result."""
    return LiveEstimator(scene.parameters, lambda _work: lambda: check)


def records(scene: Scene, arrived: list[Measurement | ImuSamples]) -> list[Any]:
    """Hand arrivals to a live estimator and return its records."""
    live = checked(scene)
    return [
        record
        for each in arrived
        for record in (live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each))
    ]


def predicted(found: list[Any]) -> list[PoseRecord]:
    """Return the predicted poses."""
    return [each for each in found if isinstance(each, PoseRecord) and each.kind == "predicted"]


def time_of(pose: PoseRecord) -> float:
    """Time of a pose from the start."""
    return (pose.stamp_ns - START) / SECOND


def uses_from(poses: list[PoseRecord]) -> list[tuple[str | None, float]]:
    """Each use of the IMU, and from when."""
    return [
        (pose.imu, time_of(pose))
        for before, pose in zip([None, *poses], poses, strict=False)
        if before is None or before.imu != pose.imu
    ]


def test_poses_use_the_imu_once_its_trajectory_has_converged(scene: Scene) -> None:
    """Before, they are those without it."""
    poses = predicted(records(scene, arrivals(scene, 4.0)))
    (starting, _), (used, from_s) = uses_from(poses)
    assert (starting, used) == ("starting", "used")
    assert from_s < 1.5
    assert poses[-1].position_m is not None
    assert poses[-1].position_m[2] == pytest.approx(-1.0 + UP_M, abs=1e-3)


def test_silence_gives_the_poses_without_imu_and_sound_samples_take_it_back(scene: Scene) -> None:
    """Within 0.5 s of the last sample, from measurements that were held; and with a jump on the pose."""
    poses = predicted(records(scene, arrivals(scene, 4.5, silent=(2.0, 2.8))))
    _, _, (silent, silent_s), (used, used_s) = uses_from(poses)
    assert (silent, used) == ("silent", "used")
    assert silent_s == pytest.approx(2.0 + SILENCE_S, abs=0.11)
    assert used_s == pytest.approx(2.8 + RECOVERY_S, abs=0.16)
    without = replace(scene, parameters=replace(scene.parameters, imu=None))
    expected = {pose.stamp_ns: pose for pose in predicted(records(without, arrivals(scene, 4.5)))}
    for pose in poses:
        if silent_s <= time_of(pose) < used_s:
            other = expected[pose.stamp_ns]
            assert pose.valid
            assert pose.position_m == pytest.approx(other.position_m, abs=2e-4)
            assert pose.covariance == pytest.approx(other.covariance, rel=0.05, abs=1e-7)
    jumps = [pose.jump_m for pose in poses if time_of(pose) in (silent_s, used_s)]
    assert jumps == pytest.approx([UP_M, UP_M], abs=4e-3)


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        ({"up_m": 5.0}, "sigmas from those without"),
        ({"contradicted": True}, "prisms contradict it"),
        ({"health": "it is stuck"}, "it is stuck"),
    ],
)
def test_disagreement_starts_anew_and_waits(scene: Scene, wrong: dict[str, Any], cause: str) -> None:
    """Until nothing from before is in the window."""
    arrived = arrivals(scene, 7.2)
    live = checked(scene)
    poses: list[PoseRecord] = []
    states: list[ImuState | None] = []
    for each in arrived:
        if each.received_ns > START + 2 * SECOND and len(FakeInertialSmoother.created) == 1:
            vars(FakeInertialSmoother.created[0]).update(wrong)
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += predicted(list(found))
        states.append(live.imu_state())
    assert states[-1] == ImuState(ImuUse.USED, "", (0.001, 0.002, -0.003), (0.01, -0.02, 0.03))
    assert any(state.use == ImuUse.DISAGREES and cause in state.disagreement for state in states if state)
    _, _, (disagrees, from_s), (used, until_s) = uses_from(poses)
    assert (disagrees, used) == ("disagrees", "used")
    assert 2.0 < from_s < 2.65
    assert until_s == pytest.approx(from_s + QUARANTINE_S, abs=0.11)
    assert len(FakeInertialSmoother.created) == 2
    # What the first has learned of the device's limits
    assert len({id(each.saturation) for each in FakeInertialSmoother.created}) == 1


def test_poses_after_a_change_are_those_of_an_estimator_without_imu(scene: Scene) -> None:
    """To the bit: measurements from before the change still arrive, though the window with the IMU was reinitialised after them."""
    live = checked(scene)
    poses: list[PoseRecord] = []
    arrived = arrivals(scene, 5.0)
    for each in arrived:
        if each.received_ns > START + 2 * SECOND and len(FakeInertialSmoother.created) == 1:
            FakeInertialSmoother.created[0].health = "it is stuck"
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += [pose for pose in found if isinstance(pose, PoseRecord)]
        if len(FakeInertialSmoother.created) > 1:
            FakeInertialSmoother.created[-1]._horizon_s = 2.5  # of its first sample
    without = replace(scene, parameters=replace(scene.parameters, imu=None))
    others = [pose for pose in records(without, arrived) if isinstance(pose, PoseRecord)]
    expected = {(pose.series, pose.stamp_ns): pose for pose in others}
    # Samples advance the estimator too: at the last instant a measurement counts a call later without them.
    taken_over = [pose for pose in poses if pose.imu == "disagrees" and time_of(pose) < 4.95]
    assert len(taken_over) > 20
    for pose in taken_over:
        other = expected[pose.series, pose.stamp_ns]
        assert pose.position_m == other.position_m
        assert pose.covariance == other.covariance
        assert pose.valid == other.valid


def test_wrong_setup_is_left_out_from_its_event_on(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses do not rest on an IMU that a drive has shown to be set up wrongly."""
    wrong = SetupCheck((SetupFinding("rotation", 0.02, 0.001, "the mounting is wrong"),))
    checks = [RIGHT, wrong]
    monkeypatch.setattr(imu_setup_monitor, "INTERVAL_NS", 2 * SECOND)
    live = LiveEstimator(scene.parameters, lambda _work: lambda: checks.pop(0))
    poses: list[PoseRecord] = []
    for each in arrivals(scene, 4.0):
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += predicted(list(found))
    _, event = live.imu_setup_events()
    assert event.event == "imu_setup_wrong"
    state = live.imu_state()
    assert state is not None
    assert state.disagreement == "the mounting is wrong"
    _, _, (use, from_s) = uses_from(poses)
    assert use == "wrong_setup"
    assert from_s == pytest.approx((event.stamp_ns - START) / SECOND, abs=0.11)


def test_unconfirmed_imu_is_not_used(scene: Scene) -> None:
    """Poses are those without it, and the status says what the drive has not told yet."""
    live = checked(scene, SetupCheck(excluded=frozenset({"axes"})))
    poses: list[PoseRecord] = []
    for each in arrivals(scene, 3.0):
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += predicted(list(found))
    _, (use, _) = uses_from(poses)
    assert use == "unconfirmed"
    assert poses[-1].position_m is not None
    assert poses[-1].position_m[2] == pytest.approx(-1.0, abs=1e-3)
    state = live.imu_state()
    assert state is not None
    assert state.disagreement == "not confirmed by driving yet: mounting, position, latency"


def test_unconfirmed_imu_is_used_where_there_is_nothing_else() -> None:
    """Two of three stations that measure have no poses without it; with the third there are."""
    without = SimpleNamespace(converged=False, ambiguous=False)
    window = sound_window(measured_prisms=1)
    setup = SimpleNamespace(untrusted=None, confirmed=False)
    selector = ImuSelector(
        IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window), cast("Any", setup)
    )
    selector.begin(START)
    uses = []
    for number in range(3 * round(NO_TRAJECTORY_S)):
        selector.add_samples(imu_samples(100 * number, count=100))
        selector.take_samples()
        selector.choose(0.5 * (number + 1))
        uses.append(selector.use)
        without.converged = number >= 2.5 * NO_TRAJECTORY_S
        without.ambiguous = True
    changes = [use for use, _ in itertools.groupby(uses)]
    assert changes == [ImuUse.UNCONFIRMED, ImuUse.USED, ImuUse.UNCONFIRMED]
    assert uses.index(ImuUse.USED) == round(2 * NO_TRAJECTORY_S)


def sound_window(*, measured_prisms: int = 3) -> SimpleNamespace:
    """Return a window with IMU in which all is well."""
    return SimpleNamespace(
        converged=True,
        ambiguous=False,
        health=None,
        setup_doubt="",
        lost_after_s=0.0,
        beyond_chance=False,
        followed_for_s=0.0,
        measured_prisms=measured_prisms,
        add_samples=lambda _: None,
        horizon_s=0.0,
        update=lambda _: None,
    )


def measured(time_s: float) -> Any:
    """Return a measurement of which windows take nothing but its time."""
    return SimpleNamespace(time_s=np.array([time_s]))


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> tuple[ImuSelector, SimpleNamespace, SimpleNamespace]:
    """Return what chooses, a window with IMU, and the monitor of its set-up; all is well."""
    monkeypatch.setattr(ImuSelector, "_compare", lambda *_: None)
    without = SimpleNamespace(converged=True, ambiguous=False, update=lambda _: None)
    window = sound_window()
    setup = SimpleNamespace(
        untrusted=None, confirmed=True, unconfirmed="", was_confirmed=True, may_have_moved=False
    )
    setup.restart = lambda: vars(setup).update(confirmed=False)

    def create_with(min_prisms: int) -> Any:
        window.min_prisms = min_prisms
        return window

    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), create_with, cast("Any", setup))
    selector.begin(START)
    return selector, window, setup


def uses_of(selector: ImuSelector, from_s: float, until_s: float) -> list[tuple[ImuUse, float]]:
    """Measure and choose ten times a second; return each use, and for how long."""
    uses = []
    for number in range(round(10 * from_s), round(10 * until_s)):
        selector.update(measured(0.1 * number))
        selector.add_samples(imu_samples(20 * number, count=20))
        selector.take_samples()
        selector.choose(0.1 * (number + 1))
        uses.append(selector.use)
    return [(use, 0.1 * len(list(each))) for use, each in itertools.groupby(uses)]


@pytest.mark.parametrize(
    ("fault", "use"), [("stuck", ImuUse.USED), ("shock", ImuUse.UNCONFIRMED), ("prisms", ImuUse.UNCONFIRMED)]
)
def test_setup_is_confirmed_anew_unless_the_samples_were_wrong_by_themselves(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace], fault: str, use: ImuUse
) -> None:
    """After a shock, and where the prisms contradict, the IMU may have moved for good."""
    selector, window, setup = sound
    uses_of(selector, 0.0, 1.0)
    window.health = fault if fault != "prisms" else None
    window.setup_doubt = fault if fault == "shock" else ""
    window.ambiguous = fault == "prisms"
    found = [uses_of(selector, 1.0, 1.6)[-1][0]]
    window.health, window.setup_doubt, window.ambiguous = None, "", False
    found.append(uses_of(selector, 1.6, 7.0)[-1][0])
    setup.confirmed = True
    found.append(uses_of(selector, 7.0, 7.1)[-1][0])
    assert found == [ImuUse.DISAGREES, use, ImuUse.USED]


@pytest.mark.parametrize(
    ("fault", "prisms", "expected"), [("prisms", 3, 2), ("prisms", 2, 2), ("prisms", 1, 1), ("stuck", 3, 1)]
)
def test_new_window_needs_two_prisms_where_the_wrong_prism_may_have_been_measured(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
    monkeypatch: pytest.MonkeyPatch,
    fault: str,
    prisms: int,
    expected: int,
) -> None:
    """After the prisms have contradicted the IMU, not after samples that are wrong by themselves; and until there is a trajectory."""
    selector, window, _ = sound
    monkeypatch.setattr(selector, "_prisms", prisms)
    window.followed_for_s = 0.0
    uses_of(selector, 0.0, 1.0)
    found = [window.min_prisms]
    window.health, window.setup_doubt = fault, fault if fault == "prisms" else ""
    uses_of(selector, 1.0, 1.1)
    found.append(window.min_prisms)
    window.health, window.setup_doubt = "stuck", ""
    for converged in (False, True):
        window.converged = converged
        uses_of(selector, 1.1, 1.2)
        found.append(window.min_prisms)
    assert found == [1, expected, expected, 1]


@pytest.mark.parametrize(
    ("prisms", "uncertain", "expected"),
    [(3, False, [4.0, 8.0, 16.0, 4.0]), (2, True, [4.0, 8.0, 16.0, 4.0]), (2, False, [4.0, 4.0, 4.0, 4.0])],
)
def test_quarantine_doubles_with_each_disagreement_in_a_row(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
    monkeypatch: pytest.MonkeyPatch,
    prisms: int,
    expected: list[float],
    *,
    uncertain: bool,
) -> None:
    """And is short again after a minute of use; it stays short where two prisms alone lose their poses to what the samples show."""
    selector, window, setup = sound
    monkeypatch.setattr(selector, "_prisms", prisms)
    window.followed_for_s = 0.0
    setup.restart = lambda **_: None
    found, now_s = [], 0.0
    for used_s in (1.0, 1.0, 1.0, PROVEN_S + 1.0):
        uses_of(selector, now_s, now_s + used_s)
        window.health, window.setup_doubt = "stuck", "prisms" if uncertain else ""
        uses_of(selector, now_s + used_s, now_s + used_s + 0.1)
        window.health, window.setup_doubt = None, ""
        (_, wrong_s), _ = uses_of(selector, now_s + used_s + 0.1, now_s + used_s + 20.0)
        found.append(wrong_s)
        now_s += used_s + 0.1 + wrong_s
    assert found == pytest.approx(expected, abs=0.11)


def test_samples_between_rare_poses_are_all_used() -> None:
    """Also where poses are ten seconds apart; only before the first measurement old ones are forgotten."""
    taken: list[InertialSamples] = []
    driven: list[WheelSamples] = []
    window = SimpleNamespace(add_samples=taken.append, add_odometry=driven.append)
    selector = ImuSelector(
        IMU_PARAMETERS, cast("Any", None), lambda _: cast("Any", window), odometry=OdometryParameters()
    )
    for number in range(60):  # Half seconds
        if number == 40:
            selector.begin(START)
        record = imu_samples(100 * number, count=100)
        selector.add_samples(record)
        selector.add_odometry(wheels_beside(record))
    selector.take_samples()
    (samples,), (wheels,) = taken, driven
    assert 3000 <= len(samples) <= 3100
    assert 30 <= len(wheels) <= 31


def test_silence_does_not_shorten_a_quarantine(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
) -> None:
    """An IMU that disagreed and then is silent for half a second is used no sooner."""
    selector, window, _ = sound
    uses_of(selector, 0.0, 1.0)
    window.health = "stuck"
    uses_of(selector, 1.0, 1.1)
    window.health = None
    uses_of(selector, 1.1, 2.0)
    selector.choose(2.5)
    found = uses_of(selector, 2.5, 10.0)
    assert [use for use, _ in found] == [ImuUse.SILENT, ImuUse.USED]
    assert found[0][1] == pytest.approx(1.1 + QUARANTINE_S - 2.5, abs=0.11)


def test_unconfirmed_imu_is_not_used_sooner_because_stations_had_none_long_ago(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
) -> None:
    """The time without a trajectory of the stations counts from when that was lost, also while the IMU was used."""
    selector, window, setup = sound
    setup.confirmed = False
    uses_of(selector, 0.0, 1.0)
    setup.confirmed = True
    uses_of(selector, 1.0, 30.0)
    cast("Any", selector._without).converged = False
    window.health = window.setup_doubt = "a shock"
    uses_of(selector, 30.0, 30.1)
    window.health, window.setup_doubt = None, ""
    found = uses_of(selector, 30.1, 50.0)
    assert [use for use, _ in found] == [ImuUse.DISAGREES, ImuUse.UNCONFIRMED, ImuUse.USED]
    assert 0.1 + found[0][1] + found[1][1] == pytest.approx(NO_TRAJECTORY_S, abs=0.21)


@pytest.mark.parametrize(("shocks", "counted"), [(0, 1), (1, 1), (3, 3), (9, 4)])
def test_pose_with_an_unconfirmed_imu_allows_for_a_wrong_setup(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, shocks: int, counted: int
) -> None:
    """In its covariance, more after several shocks, and it is degraded."""
    monkeypatch.setattr(ImuSelector, "shocks", shocks)
    confirmed = predicted(records(scene, arrivals(scene, 2.5)))[-1]
    monkeypatch.setattr(ImuSelector, "unconfirmed", True)
    unconfirmed = predicted(records(scene, arrivals(scene, 2.5)))[-1]
    assert "imu_unconfirmed" not in confirmed.degraded_by
    assert unconfirmed.degraded_by == ("imu_unconfirmed",)
    assert confirmed.covariance is not None
    assert unconfirmed.covariance is not None
    added = np.diag((np.array(unconfirmed.covariance) - np.array(confirmed.covariance)).reshape(6, 6))
    assert added[3:] == pytest.approx(counted * np.radians(0.5) ** 2, rel=2e-3)
    assert (added[:3] >= counted * 0.0049**2).all()


def test_outage_of_all_prisms_with_an_unconfirmed_imu(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong in the set-up grows with time: there are no valid poses beyond the outage limit, which a confirmed one has."""
    pipeline = replace(scene.parameters.pipeline, outage_limit_ns=3 * SECOND // 10)
    scene = replace(scene, parameters=replace(scene.parameters, pipeline=pipeline))
    last_ns = START + 5 * SECOND // 2
    arrived = [
        each for each in arrivals(scene, 3.2) if isinstance(each, ImuSamples) or each.stamp_ns < last_ns
    ]

    def in_outage() -> list[PoseRecord]:
        return [each for each in predicted(records(scene, arrived)) if time_of(each) > 2.85]

    assert any(each.valid for each in in_outage())
    monkeypatch.setattr(ImuSelector, "unconfirmed", True)
    assert {(each.valid, each.reason) for each in in_outage()} == {(False, "outage")}


STUCK, DISAGREES = "it repeats the same values", "it disagrees with the prisms"


@pytest.mark.parametrize(
    ("prisms", "followed_for_s", "health", "contradicted"),
    [
        (1, 0.4, None, True),
        (1, 0.0, None, False),
        (2, 0.4, None, True),
        (3, 0.4, None, True),
        (1, 0.0, DISAGREES, True),
        (1, 0.0, STUCK, False),
        (2, 0.0, DISAGREES, False),
    ],
)
def test_contradiction_of_one_or_two_stations_lasts(
    prisms: int, followed_for_s: float, health: str | None, *, contradicted: bool
) -> None:
    """Where the trajectory follows what contradicted the IMU; one measurement alone, an outlier, or an IMU that is stuck, is none."""
    without = SimpleNamespace(converged=False, ambiguous=True, update=lambda _: None)
    window = sound_window(measured_prisms=1)
    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window), prisms=prisms)
    selector.begin(START)
    found = []
    for number in range(20):
        window.ambiguous = 8 <= number < 12
        window.followed_for_s = followed_for_s if number >= 12 else 0.0
        window.health = health if number == 10 else None
        selector.add_samples(imu_samples(100 * number, count=100))
        selector.take_samples()
        selector.choose(0.5 * (number + 1))
        found.append(selector.station_contradicted)
    assert not any(found[:10])
    assert found[-1] == contradicted


@pytest.mark.parametrize(
    ("prisms", "what", "health", "contradicted"),
    [
        (1, "lost", None, True),
        (2, "lost", None, False),
        (1, "beyond chance", STUCK, True),
        (1, "by chance", STUCK, False),
        (1, "beyond chance", None, False),
    ],
)
def test_trajectory_given_up_in_a_contradiction_contradicts_a_single_station(
    prisms: int, what: str, health: str | None, *, contradicted: bool
) -> None:
    """The next one starts where the station then is: after a loss, or after a fault of the IMU that has nothing to do with it."""
    without = SimpleNamespace(converged=False, ambiguous=True, update=lambda _: None)
    window = sound_window(measured_prisms=1)
    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window), prisms=prisms)
    selector.begin(START)
    for number in range(20):
        window.ambiguous = number in (8, 9)
        window.beyond_chance = window.ambiguous and what == "beyond chance"
        window.converged = not (what == "lost" and number == 10)
        window.lost_after_s = 0.4 if what == "lost" and number == 10 else 0.0
        window.health = health if number == 9 else None
        selector.add_samples(imu_samples(100 * number, count=100))
        selector.take_samples()
        selector.choose(0.5 * (number + 1))
        if number < 9:
            assert not selector.station_contradicted
    assert selector.station_contradicted == contradicted


def test_three_stations_of_which_one_measures_are_contradicted_until_the_others_tell() -> None:
    """They are no better than one."""
    without = SimpleNamespace(converged=False, ambiguous=True, update=lambda _: None)
    window = sound_window(measured_prisms=1)
    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window))
    selector.begin(START)
    found = []
    for number in range(20):
        window.ambiguous = 8 <= number < 12
        window.followed_for_s = 0.4 if number >= 12 else 0.0
        window.measured_prisms = 3 if number >= 16 else 1
        without.converged = number >= 18
        selector.add_samples(imu_samples(100 * number, count=100))
        selector.take_samples()
        selector.choose(0.5 * (number + 1))
        found.append(selector.station_contradicted)
    assert found == [False] * 12 + [True] * 6 + [False] * 2


@pytest.mark.parametrize(("measured_until_s", "use"), [(1.5, ImuUse.USED), (10.0, ImuUse.DISAGREES)])
def test_trajectory_without_imu_tells_nothing_in_an_outage(measured_until_s: float, use: ImuUse) -> None:
    """The one with it began just before, and has not become certain since."""
    without = SimpleNamespace(converged=True, ambiguous=False, update=lambda _: None)
    window = sound_window()
    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window))
    selector.begin(START)
    selector._next_comparison_s = np.inf
    uses = []
    for number in range(40):
        now_s = 0.1 * (number + 1)
        if now_s < measured_until_s:
            selector.update(measured(now_s))
        window.ambiguous = number >= 26
        selector.add_samples(imu_samples(20 * number, count=20))
        selector.take_samples()
        selector.choose(now_s)
        uses.append(selector.use)
    assert uses[26] == ImuUse.USED
    assert uses[-1] == use


def test_disagreement_before_the_imu_fell_silent_counts(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
) -> None:
    """Its samples ended before anybody asked, and its set-up must be confirmed anew."""
    selector, window, setup = sound
    uses_of(selector, 0.0, 1.0)
    window.setup_doubt = DISAGREES
    selector.choose(3.5)
    assert (selector.use, setup.confirmed) == (ImuUse.DISAGREES, False)
    window.setup_doubt = ""
    selector.choose(3.6)
    assert selector.use == ImuUse.SILENT


@pytest.mark.parametrize(("consistent_before", "contradicted"), [(True, True), (False, False)])
def test_trajectory_that_was_never_consistent_contradicts_no_station(
    *, consistent_before: bool, contradicted: bool
) -> None:
    """What a new start finds first may be wrong, and is bent towards the measurements."""
    without = SimpleNamespace(converged=False, ambiguous=True, update=lambda _: None)
    window = sound_window(measured_prisms=1)
    selector = ImuSelector(IMU_PARAMETERS, cast("Any", without), lambda _: cast("Any", window), prisms=2)
    selector.begin(START)
    for number in range(20):
        window.converged = not 4 <= number < 8
        window.ambiguous = 4 <= number < 12 and not (consistent_before and number == 8)
        window.followed_for_s = 0.4 if number >= 12 else 0.0
        selector.add_samples(imu_samples(100 * number, count=100))
        selector.take_samples()
        selector.choose(0.5 * (number + 1))
    assert selector.station_contradicted == contradicted


@pytest.mark.parametrize(
    ("health", "doubt", "disagrees"),
    [
        (DISAGREES, DISAGREES, True),
        pytest.param(SHOCK, SHOCK, False, marks=pytest.mark.slow),
        pytest.param(STUCK, "", False, marks=pytest.mark.slow),
    ],
)
def test_imu_that_disagreed_without_a_shock_degrades_the_poses_without_it(
    scene: Scene, health: str, doubt: str, *, disagrees: bool
) -> None:
    """It, a tripod or a prism may have moved, until it is used again."""
    live = checked(scene)
    poses = []
    for each in arrivals(scene, 24.0):
        window = FakeInertialSmoother.created[-1] if FakeInertialSmoother.created else None
        if window is not None and 9.9 < (each.received_ns - START) / SECOND < 10.0:
            window.health, window.setup_doubt = health, doubt
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += predicted(list(found))
    by_use = {
        use: {"imu_disagrees" in pose.degraded_by for pose in poses if pose.valid and pose.imu == use}
        for use in ("used", "disagrees", "unconfirmed")
    }
    assert by_use["used"] == {False}
    assert by_use["disagrees"] == {disagrees}
    assert time_of(poses[-1]) > 23.0
    assert poses[-1].imu == "used"


@pytest.mark.parametrize(
    ("was_confirmed", "may_have_moved", "disagrees"),
    [(True, True, True), (True, False, False), (False, False, False)],
)
def test_setup_that_was_never_right_is_no_move(
    sound: tuple[ImuSelector, SimpleNamespace, SimpleNamespace],
    *,
    was_confirmed: bool,
    may_have_moved: bool,
    disagrees: bool,
) -> None:
    """Nor is a wrong latency, or an IMU that was used unconfirmed."""
    selector, _, setup = sound
    uses_of(selector, 0.0, 1.0)
    setup.untrusted, setup.confirmed = "the set-up is wrong", False
    setup.was_confirmed, setup.may_have_moved = was_confirmed, may_have_moved
    assert uses_of(selector, 1.0, 2.0)[0][0] == ImuUse.WRONG_SETUP
    assert selector.disagrees == disagrees


def test_poses_of_a_contradicted_station_are_invalid(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """And say why."""
    monkeypatch.setattr(ImuSelector, "_watch_stations", lambda *_: None)
    live = checked(scene)
    poses = []
    for each in arrivals(scene, 3.0):
        estimator = live._estimator
        assert isinstance(estimator, ContinuousEstimator)
        assert estimator._imu is not None
        estimator._imu.station_contradicted = each.received_ns > START + 2 * SECOND
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += predicted(list(found))
    reasons = {pose.reason for pose in poses if time_of(pose) > 2.1}
    assert reasons == {"contradicted"}
    assert any(pose.valid for pose in poses)


def test_first_pose_after_a_measurement_states_its_jump(scene: Scene) -> None:
    """And no other."""
    found = records(scene, arrivals(scene, 4.0))
    poses = [pose for pose in predicted(found) if time_of(pose) > 2.0]
    measured = [each.received_ns for each in found if isinstance(each, Measurement)]
    for before, pose in itertools.pairwise(poses):
        new = any(before.stamp_ns <= at_ns < pose.stamp_ns for at_ns in measured)
        assert (pose.jump_m is not None) == new
        assert pose.jump_m is None or pose.jump_m < 0.05


def test_samples_follow_the_poses_due_before_them(scene: Scene) -> None:
    """In their place among all records, and at no instant before."""
    live = LiveEstimator(scene.parameters)
    live.measurement(scene.measure(1, 0.0))
    *poses, samples = live.imu_samples(imu_samples(100))
    assert poses
    assert all(isinstance(pose, PoseRecord) for pose in poses)
    assert samples == imu_samples(100)
    (clamped,) = live.imu_samples(imu_samples(90))
    assert clamped.received_ns == imu_samples(100).received_ns  # type: ignore[union-attr]


def test_samples_change_nothing_without_parameters_of_an_imu(scene: Scene) -> None:
    """Bit for bit, also the instants of measurements."""
    without = replace(scene, parameters=replace(scene.parameters, imu=None))
    arrived = arrivals(scene, 3.0)
    alone = records(without, [each for each in arrived if not isinstance(each, ImuSamples)])
    mixed = [each for each in records(without, arrived) if not isinstance(each, ImuSamples)]
    count = min(len(alone), len(mixed))
    assert list(map(encode_line, alone[:count])) == list(map(encode_line, mixed[:count]))
    assert b'"imu"' not in encode_line(alone[-1])


def test_smoother_gets_all_samples_from_before_its_measurements_on(scene: Scene) -> None:
    """Each once, in their order."""
    records(scene, arrivals(scene, 2.0))
    end_s = np.concatenate([each.end_s for each in FakeInertialSmoother.created[0].samples])
    assert np.diff(end_s) == pytest.approx(0.005, abs=1e-9)
    assert end_s[0] < 0.0


@pytest.mark.parametrize(("rejected_s", "use"), [(1.9, "used"), (2.1, "disagrees")])
def test_use_of_wheels_is_known(scene: Scene, rejected_s: float, use: str) -> None:
    """They are silent a second after the last sample, and without IMU there is none."""
    parameters = replace(scene.parameters, odometry=OdometryParameters())
    live = LiveEstimator(parameters, lambda _work: lambda: RIGHT)
    words: list[tuple[str, float]] = []
    for each in arrivals(scene, 6.0, silent=(3.5, np.inf)):
        if isinstance(each, ImuSamples):
            live.imu_samples(each)
            if each.received_ns < START + 2 * SECOND:
                live.odometry_samples(wheels_beside(each))
        else:
            live.measurement(each)
        wheels = WheelsEstimate(np.zeros(3), np.ones(3), 4.0, rejected_s)
        FakeInertialSmoother.created[0].wheels = wheels
        state = live.imu_state()
        assert state is not None
        assert state.odometry is not None
        if not words or words[-1][0] != state.odometry.use:
            words.append((state.odometry.use, (each.received_ns - START) / SECOND))
    assert [word for word, _ in words] == ["silent", "without_imu", use, "silent"]
    assert words[-1][1] == pytest.approx(3.0, abs=0.1)
    assert live.imu_state() is not None


def wheels_beside(samples: ImuSamples) -> OdometrySamples:
    """Return one sample of wheel odometry that ends with a line of the IMU."""
    return OdometrySamples(
        sequence=samples.sequence // 10,
        received_ns=samples.received_ns,
        stamp_ns=samples.stamp_ns[-1:],
        duration_ns=(50_000_000,),
        instrument_time_ns=None,
        speed_mps=(0.5,),
        yaw_rate_radps=None,
        valid=(True,),
    )


@pytest.mark.parametrize(
    ("prisms", "statuses", "contradicted"),
    [
        (1, "tilt tilt ok", True),
        (1, "tilt ok tilt", False),
        (1, "no_target no_target", False),
        (2, "tilt tilt", False),
    ],
)
def test_single_instrument_that_is_not_level_has_moved(
    scene: Scene, prisms: int, statuses: str, *, contradicted: bool
) -> None:
    """Once is a bump; of several the others tell."""
    stations = scene.parameters.stations[:prisms]
    parameters = replace(scene.parameters, stations=stations, prisms=scene.parameters.prisms[:prisms])
    estimator = ContinuousEstimator(parameters)
    assert estimator._imu is not None
    estimator._imu._established = True
    measurement = next(each for each in arrivals(scene, 1.0) if isinstance(each, Measurement))
    for status in statuses.split():
        estimator.add(replace(measurement, status=Status(status)))
    assert estimator._imu.station_contradicted == contradicted
