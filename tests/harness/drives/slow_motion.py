"""Slow motions of a level robot at the reference scenario's place, and their measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import CENTRE_M, SIGMAS_M, add_polar_noise
from harness.drives.scene import FRAMES, LAYOUT

from tsgt.geometry import invert, transform_points
from tsgt.geometry.trajectory import Observations

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.geometry import FloatArray

LINE_OF_SIGHT = CENTRE_M[:2] / np.linalg.norm(CENTRE_M[:2])


def creeping(speed_mps: float) -> Callable[[FloatArray], FloatArray]:
    """Displacement at a constant speed along the line of sight, which is measured worst."""
    return lambda time_s: speed_mps * time_s


def braking(speed_mps: float, at_s: float, duration_s: float) -> Callable[[FloatArray], FloatArray]:
    """Displacement of a robot that brakes evenly."""

    def along_m(time_s: FloatArray) -> FloatArray:
        before_s, braking_s = np.minimum(time_s - at_s, 0.0), np.clip(time_s - at_s, 0.0, duration_s)
        return speed_mps * (before_s + braking_s - 0.5 * braking_s**2 / duration_s)

    return along_m


def measure_along(
    along_m: Callable[[FloatArray], FloatArray],
    *,
    until_s: float,
    seed: int,
    vibration_m: float = 0.0,
    stations: Sequence[int] = (0, 1, 2),
    rate_hz: float = 2.5,
    noise_scale: float = 1.0,
) -> Observations:
    """Measure a robot that moves along the line of sight; each prism by its own one of the stations, at exact times.

    ``noise_scale``: factor of the noise over the stated one.
    """
    rng = np.random.default_rng(seed)
    count = int(until_s * rate_hz)
    time_s = (np.arange(count)[:, None] / rate_hz + rng.uniform(0, 1 / rate_hz, 3)).ravel()
    prism = np.tile(np.arange(3), count)
    order = np.argsort(time_s)
    order = order[np.isin(prism[order], stations)]
    time_s, prism = time_s[order], prism[order]
    layout = LAYOUT - LAYOUT.mean(axis=0)
    world = CENTRE_M + layout[prism]
    world[:, :2] += along_m(time_s)[:, None] * LINE_OF_SIGHT
    world += rng.normal(size=world.shape) * vibration_m
    return Observations(
        time_s=time_s,
        time_sigma_s=np.full(len(time_s), 1e-5),
        points_m=add_polar_noise(
            transform_points(invert(FRAMES)[prism], world), noise_scale * np.asarray(SIGMAS_M), rng
        ),
        sigmas_m=np.tile(SIGMAS_M, (len(time_s), 1)),
        polar=np.ones(len(time_s), dtype=bool),
        station=prism,
        prism=prism,
        frames=FRAMES,
        layout=layout,
    )
