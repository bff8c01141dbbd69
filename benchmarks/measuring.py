"""What the benchmarks share: time and memory, missions, normalised errors."""

from __future__ import annotations

import resource
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tsgt.log import configure_logging
from tsgt.simulation.runner import simulate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from tsgt.config import ScenarioConfig
    from tsgt.simulation.mission import MissionResult
    from tsgt.simulation.options import SimulationOptions


class Stopwatch:
    """Measures CPU time of this process and wall time, in s: inside its block as it runs, after it as it was."""

    def __init__(self) -> None:
        self._wall_s = self._cpu_s = 0.0
        self._ended: tuple[float, float] | None = None

    def __enter__(self) -> Self:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = (self.wall_s, self.cpu_s)

    @property
    def wall_s(self) -> float:
        """Wall time."""
        return time.perf_counter() - self._wall_s if self._ended is None else self._ended[0]

    @property
    def cpu_s(self) -> float:
        """CPU time of this process, all threads."""
        return time.process_time() - self._cpu_s if self._ended is None else self._ended[1]


def best_s(call: Callable[[], object], repeats: int) -> float:
    """Return the shortest wall time of several calls, in s."""
    times_s = []
    for _ in range(repeats):
        with Stopwatch() as stopwatch:
            call()
        times_s.append(stopwatch.wall_s)
    return min(times_s)


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process, in MB of 2^20 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def normalised_squared(errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e^T P^-1 e of each error (NEES; Bar-Shalom et al., Estimation with Applications, section 5.4).

    Parameters
    ----------
    errors
        (..., n)
    covariances
        (..., n, n)
    """
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.einsum("...i,...i->...", errors, solved))


@contextmanager
def simulated(
    scenario: ScenarioConfig, options: SimulationOptions, **arguments: Any
) -> Iterator[MissionResult]:
    """Simulate a mission in a temporary folder, which lasts as long as the block; logs show errors only."""
    configure_logging("error")
    with tempfile.TemporaryDirectory(prefix="tsgt-benchmark-") as folder:
        yield simulate(scenario, options, folder=Path(folder), **arguments)
