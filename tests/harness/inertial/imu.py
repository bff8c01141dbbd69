"""Lines of a program that reads an IMU at rest."""

from __future__ import annotations

from typing import Any

HELLO = {"type": "hello", "imu": 1, "make": "Fake", "model": "IMU", "rate_hz": 200.0}

PERIOD_NS = 5_000_000
DEVICE_START_NS = 7_000_000_000


def samples(first: int, count: int, host_ns: int | None = None, **changes: Any) -> dict[str, Any]:
    """Return a line with samples of a device whose clock runs exactly.

    ``host_ns``: when the first one is read. ``changes``: other values of the lists; None removes one.
    """
    numbers = range(first, first + count)
    line: dict[str, Any] = {
        "type": "samples",
        "counter": list(numbers),
        "instrument_time_ns": [DEVICE_START_NS + number * PERIOD_NS for number in numbers],
        # Noise-free values would be stuck ones.
        "angular_rate_radps": [[1e-6 * number, 0.0, 0.01] for number in numbers],
        "specific_force_mps2": [[0.0, 0.0, 9.81] for _ in numbers],
    }
    if host_ns is not None:
        line["host_time_ns"] = [host_ns + i * PERIOD_NS for i in range(count)]
    line |= changes
    return {key: value for key, value in line.items() if value is not None}
