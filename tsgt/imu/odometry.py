"""The wheel odometry of the robot: runs the program that reads it, and passes its samples on."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, NoReturn

import structlog

from tsgt.imu.monitor import SampleCounter
from tsgt.imu.odometry_lines import OdometryHelloLine, OdometryLine, check_speed, decode_odometry_line
from tsgt.imu.program import CHECK_PERIOD_NS, DeviceProgram
from tsgt.imu.sampler import DeviceSampler, RecordTimes
from tsgt.model import OdometrySamples
from tsgt.recording import OdometryStatus
from tsgt.service import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock, UnixTimeline
    from tsgt.config import OdometryConfig
    from tsgt.service import StartProgram

log = structlog.get_logger()


class _Driven(NamedTuple):
    """One sample; ``speed_mps`` by the device's clock, where it gives distances."""

    speed_mps: float
    distance_m: float | None
    yaw_rate_radps: float | None
    valid: bool


class OdometrySampler(DeviceSampler[OdometryLine, OdometrySamples]):
    """Assigns times to the samples; values are speed, yaw rate if there is one, and validity."""

    def _values(self, line: OdometryLine, index: int, duration_ns: int) -> _Driven:
        if line.speed_mps is not None:
            speed, distance = line.speed_mps[index], None
        else:
            assert line.distance_m is not None  # noqa: S101 (a line has one of both)
            distance = line.distance_m[index]
            speed = distance / (duration_ns / 1e9)
        check_speed(speed)
        rate = None if line.yaw_rate_radps is None else line.yaw_rate_radps[index]
        return _Driven(speed, distance, rate, line.valid is None or line.valid[index])

    def _record_of(self, times: RecordTimes, values: Sequence[_Driven]) -> OdometrySamples:
        rates = [each.yaw_rate_radps for each in values if each.yaw_rate_radps is not None]
        # The encoder counts metres, whatever the device's clock takes for a second.
        speeds = (
            each.speed_mps if each.distance_m is None else each.distance_m / (duration_ns / 1e9)
            for each, duration_ns in zip(values, times.duration_ns, strict=True)
        )
        return OdometrySamples(
            **times._asdict(),
            speed_mps=tuple(speeds),
            yaw_rate_radps=tuple(rates) if len(rates) == len(values) else None,
            valid=tuple(each.valid for each in values),
        )


class WheelOdometry(DeviceProgram):
    """The robot's wheel odometry; parameters as of :class:`~tsgt.imu.Imu`."""

    def __init__(
        self,
        config: OdometryConfig,
        clock: Clock,
        timeline: UnixTimeline,
        *,
        on_samples: Callable[[OdometrySamples], None],
        on_event: Callable[[str, str], None],
        start: StartProgram | None = None,
    ) -> None:
        super().__init__(
            config.command,
            config.stall_timeout_s,
            clock,
            timeline,
            OdometrySampler(timeline.unix_at_zero_ns),
            setting="odometry.command",
            decode=decode_odometry_line,
            start=start,
        )
        self._on_samples = on_samples
        self._on_event = on_event
        self._counter = SampleCounter()
        self._untrusted = 0
        self._device = ""
        self._lost = False

    def status(self) -> OdometryStatus:
        """Return the status at present, but for what the estimator knows."""
        now_ns, counter = self._now_ns(), self._counter
        problem = "" if self._session is None else self._session.status.problem
        if counter.is_lost(now_ns):
            problem = self._problem_of_program() or "there are no samples"
        return OdometryStatus(
            device=self._device,
            samples=counter.samples,
            rate_hz=counter.rate_hz(now_ns),
            age_s=counter.age_s(now_ns),
            gaps=counter.gaps,
            lost=counter.lost,
            untrusted=self._untrusted,
            clock_skew_ppm=self._sampler.clock_skew_ppm,
            problem=problem,
        )

    def _hello(self, hello: OdometryHelloLine) -> None:
        self._device = printable(" ".join(filter(None, (hello.make, hello.model, hello.serial_number))))
        self._counter.program_started()
        log.info(
            "odometry_connected",
            device=self._device,
            rate_hz=hello.rate_hz,
            clock=printable(hello.clock),
        )

    def _take(self, samples: OdometrySamples) -> None:
        self._error = ""
        self._counter.count(samples)
        self._untrusted += samples.valid.count(False)
        self._on_samples(samples)

    async def _check(self) -> NoReturn:
        while True:
            await self._clock.sleep_until(self._clock.monotonic_ns() + CHECK_PERIOD_NS)
            lost = self._counter.is_lost(self._now_ns())
            if lost and not self._lost and self._overdue():
                self._lost = True
                self._on_event(
                    "odometry_lost", f"the wheel odometry gives no samples: {self.status().problem}"
                )
            elif self._lost and not lost:
                self._lost = False
                self._on_event("odometry_recovered", "the wheel odometry gives samples again")

    def _log_stderr(self, text: str, dropped: int) -> None:
        log.info("odometry_stderr", text=text, dropped=dropped)

    def _log_rejected(self, error: str, line: str, rejected: int) -> None:
        log.warning("odometry_line_rejected", error=error, line=line, rejected=rejected)

    def _log_failed(self, error: str) -> None:
        log.error("odometry_program_failed", error=error)
