"""The program that reads the simulated IMU, as a mission's master starts it: prints JSON lines at their instants."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.clock import Clock
    from tsgt.service import Listener
    from tsgt.simulation.imu.presets import ImuModel
    from tsgt.simulation.imu.samples import DeviceSamples

SAMPLES_PER_LINE: Final = 5

MAX_WAIT_S: Final = 0.030
"""An incomplete line is printed when a sample arrives this long after its first one."""


class DeviceProgram:
    """Starts a program that reads a device any number of times; it prints the samples that arrive while it runs.

    ``hello``: its first line. ``arrival_s``: of each sample at the host. ``line_of``: returns the line of some samples.
    ``clock`` shows true time as CLOCK_MONOTONIC, as the master's does.
    """

    def __init__(
        self,
        hello: dict[str, object],
        arrival_s: NDArray[np.float64],
        line_of: Callable[[slice], dict[str, object]],
        clock: Clock,
    ) -> None:
        self._clock = clock
        self.hello = _encoded(hello)
        self._arrival_s, self._line_of = arrival_s, line_of
        self._starts = _line_starts(arrival_s)

    async def start(self, _command: Sequence[str], listener: Listener) -> RunningImuProgram:
        """Start the program."""
        return RunningImuProgram(asyncio.create_task(self._print(listener)))

    async def _print(self, listener: Listener) -> None:
        listener.output_received(self.hello, self._clock.monotonic_ns())
        for arrival_ns, line in self.lines(self._clock.monotonic_ns() / 1e9):
            await self._clock.sleep_until(arrival_ns)
            listener.output_received(line, self._clock.monotonic_ns())
        await asyncio.Event().wait()

    def lines(self, from_s: float = 0.0) -> Iterator[tuple[int, bytes]]:
        """Yield the lines from a time on, each with its arrival in ns from the start."""
        arrival_s = self._arrival_s
        first = int(np.searchsorted(arrival_s, from_s))
        line = int(np.searchsorted(self._starts, first, side="right"))
        for end in [*self._starts[line:].tolist(), len(arrival_s)]:
            if end > first:
                yield round(arrival_s[end - 1] * 1e9), _encoded(self._line_of(slice(first, end)))
            first = end


class ImuProgram(DeviceProgram):
    """The program that reads the simulated IMU."""

    def __init__(self, model: ImuModel, samples: DeviceSamples, clock: Clock) -> None:
        hello: dict[str, object] = {
            "type": "hello",
            "imu": 1,
            "make": "Simulated",
            "rate_hz": model.rate_hz,
            "clock": "time since start-up",
            "angular_rate_limit_radps": model.gyro_range_radps,
            "specific_force_limit_mps2": model.accelerometer_range_mps2,
        }

        host_ns = np.rint(samples.arrival_s * 1e9).astype(np.int64)
        rates, forces = np.round(samples.angular_rate_radps, 9), np.round(samples.specific_force_mps2, 9)

        def line_of(rows: slice) -> dict[str, object]:
            return {
                "type": "samples",
                "counter": samples.counter[rows].tolist(),
                "instrument_time_ns": samples.device_ns[rows].tolist(),
                "host_time_ns": host_ns[rows].tolist(),
                "angular_rate_radps": rates[rows].tolist(),
                "specific_force_mps2": forces[rows].tolist(),
            }

        super().__init__(hello, samples.arrival_s, line_of, clock)


class RunningImuProgram:
    """One run of the program; it ends on request, never by itself."""

    def __init__(self, task: asyncio.Task[None]) -> None:
        self._task = task

    def write(self, data: bytes) -> None:
        """Ignore what comes on stdin."""

    def kill(self) -> None:
        """End at once."""
        self._task.cancel()

    async def terminate(self) -> None:
        """End."""
        self._task.cancel()
        await asyncio.wait([self._task])


def _line_starts(arrival_s: NDArray[np.float64]) -> NDArray[np.intp]:
    """First sample of each line."""
    starts: list[int] = []
    first = 0
    while first < len(arrival_s):
        starts.append(first)
        in_time = int(np.searchsorted(arrival_s, arrival_s[first] + MAX_WAIT_S, side="right"))
        first = max(first + 1, min(first + SAMPLES_PER_LINE, in_time))
    return np.array(starts, dtype=np.intp)


def _encoded(line: dict[str, object]) -> bytes:
    return json.dumps(line, separators=(",", ":")).encode() + b"\n"
