"""The simulated program that reads the IMU: lines at their instants, restarts, its end."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.config import SimulatedImu
from tsgt.simulation.imu import INDUSTRIAL, ImuProgram, LateBurst, Silence, simulate_imu
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.simulation.imu import DeviceSamples, ImuCondition

CONFIG = SimulatedImu(model="industrial")


def _at_rest(times_s: NDArray[np.float64]) -> RigidMotion:
    zero = np.zeros((len(times_s), 3))
    return RigidMotion(np.broadcast_to(np.eye(3), (len(zero), 3, 3)), zero, zero, zero, zero, zero)


def _samples(*conditions: ImuCondition) -> DeviceSamples:
    return simulate_imu(CONFIG, _at_rest, 4.0, seed=[1], conditions=conditions).samples


class Output:
    """A listener that keeps lines and their instants."""

    def __init__(self) -> None:
        self.lines: list[tuple[float, dict[str, Any]]] = []

    def output_received(self, data: bytes, at_ns: int) -> None:
        """Take one line."""
        assert data.endswith(b"\n")
        assert data.count(b"\n") == 1
        self.lines.append((at_ns / 1e9, json.loads(data)))

    def exited(self, reason: str) -> None:
        """Fail: it does not end by itself."""
        raise AssertionError(reason)


def _run(samples: DeviceSamples, spans_s: Sequence[tuple[float, float]]) -> list[Output]:
    """Run the program in these intervals."""

    async def run() -> list[Output]:
        clock = VirtualClock(0)
        program = ImuProgram(INDUSTRIAL, samples, clock)
        outputs = []
        for start_s, end_s in spans_s:
            await clock.sleep_until(round(start_s * 1e9))
            outputs.append(Output())
            running = await program.start(["imu"], outputs[-1])
            await clock.sleep_until(round(end_s * 1e9))
            await running.terminate()
        await clock.sleep_until(5_000_000_000)
        return outputs

    return run_virtual(run, VirtualTimeline())


def test_lines_hold_all_samples_at_their_arrival() -> None:
    """After hello, five samples a line, each line at the arrival of its last sample."""
    samples = _samples()
    (output,) = _run(samples, [(0.0, 4.5)])
    (_, hello), *lines = output.lines
    assert (hello["type"], hello["imu"], hello["rate_hz"]) == ("hello", 1, 200.0)
    assert [number for _, line in lines for number in line["counter"]] == samples.counter.tolist()
    assert {len(line["counter"]) for _, line in lines[:-1]} == {5}
    for at_s, line in lines:
        assert round(at_s * 1e9) == line["host_time_ns"][-1]
    rates = np.concatenate([line["angular_rate_radps"] for _, line in lines])
    np.testing.assert_allclose(rates, samples.angular_rate_radps, atol=1e-9)
    times_ns = [each for _, line in lines for each in line["instrument_time_ns"]]
    assert times_ns == samples.device_ns.tolist()


def test_restarted_program_prints_what_arrives_from_then_on() -> None:
    """Samples that arrive while it is down are lost; a second hello comes first."""
    samples = _samples()
    first, second = _run(samples, [(0.0, 1.0), (2.0, 5.0)])
    assert first.lines[-1][0] <= 1.0
    assert second.lines[0][1]["type"] == "hello"
    counters = [number for _, line in second.lines[1:] for number in line["counter"]]
    assert counters == samples.counter[samples.arrival_s >= 2.0].tolist()


def test_nothing_is_printed_in_silence() -> None:
    """An incomplete line is printed with the first sample after the silence at the latest, by itself."""
    samples = _samples(Silence(1.0, 1.5))
    (output,) = _run(samples, [(0.0, 5.0)])
    assert not [at_s for at_s, _ in output.lines if 1.06 < at_s < 2.5]
    for _, line in output.lines[1:]:
        arrivals_ns = line["host_time_ns"]
        assert arrivals_ns[-1] - arrivals_ns[0] <= 30_000_000


def test_late_burst_is_printed_at_once() -> None:
    """All lines of a burst come at the same instant."""
    (output,) = _run(_samples(LateBurst(1.0, 0.5)), [(0.0, 5.0)])
    burst = [line for at_s, line in output.lines if at_s == 1.5]
    assert sum(len(line["counter"]) for line in burst) > 90
