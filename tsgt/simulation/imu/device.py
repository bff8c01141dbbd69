"""One device of a class of IMUs: its errors of manufacture, its warm-up and its clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.simulation.imu.presets import ImuModel

SWITCHED_ON_S: Final = 120.0
"""The IMU is switched on this long before a mission starts."""

AMBIENT_C: Final = 20.0


@dataclass(frozen=True, slots=True)
class ImuDevice:
    """Errors of one device; the same in all missions."""

    model: ImuModel
    gyro_matrix: NDArray[np.float64]  # (3, 3) scale factors and misalignment at the start of a mission
    accelerometer_matrix: NDArray[np.float64]  # (3, 3)
    gyro_g_sensitivity: NDArray[np.float64]  # (3, 3) in rad/s per m/s^2
    gyro_bias_per_k: NDArray[np.float64]  # (3,) in rad/s/K
    accelerometer_bias_per_k: NDArray[np.float64]  # (3,) in m/s^2/K
    gyro_scale_per_k: NDArray[np.float64]  # (3,) in 1/K
    accelerometer_scale_per_k: NDArray[np.float64]  # (3,) in 1/K
    clock_skew: float  # at the start of a mission; positive: its clock runs fast
    clock_skew_per_k: float

    @classmethod
    def drawn(cls, model: ImuModel, serial_number: int) -> ImuDevice:
        """Draw a device by its serial number."""
        rng = np.random.default_rng([serial_number, 0x1D])
        return cls(
            model,
            np.eye(3) + rng.normal(0.0, model.gyro_scale_misalignment, (3, 3)),
            np.eye(3) + rng.normal(0.0, model.accelerometer_scale_misalignment, (3, 3)),
            rng.normal(0.0, model.gyro_g_sensitivity, (3, 3)),
            rng.normal(0.0, model.gyro_bias_per_k, 3),
            rng.normal(0.0, model.accelerometer_bias_per_k, 3),
            rng.normal(0.0, model.gyro_scale_per_k, 3),
            rng.normal(0.0, model.accelerometer_scale_per_k, 3),
            rng.normal(0.0, model.clock_skew_ppm) * 1e-6,
            rng.normal(0.0, model.clock_skew_ppm_per_k) * 1e-6,
        )

    def warming_k(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the temperature rise since the start of the mission at N instants, (N,)."""
        tau_s = self.model.warm_up_time_s
        warming: NDArray[np.float64] = (
            -self.model.warm_up_k * np.exp(-SWITCHED_ON_S / tau_s) * np.expm1(-times_s / tau_s)
        )
        return warming

    def temperature_c(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the temperature of the device at N instants, (N,)."""
        at_start_k = -self.model.warm_up_k * np.expm1(-SWITCHED_ON_S / self.model.warm_up_time_s)
        temperature_c: NDArray[np.float64] = AMBIENT_C + at_start_k + self.warming_k(times_s)
        return temperature_c

    def clock_s(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the time that its clock has counted since the start of the mission at N instants, (N,)."""
        tau_s = self.model.warm_up_time_s
        at_start_k = self.model.warm_up_k * np.exp(-SWITCHED_ON_S / tau_s)
        # The integral of the warming.
        warming_ks = at_start_k * (times_s + tau_s * np.expm1(-times_s / tau_s))
        clock_s: NDArray[np.float64] = (
            times_s + self.clock_skew * times_s + self.clock_skew_per_k * warming_ks
        )
        return clock_s

    def true_s(self, clock_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the instants at which its clock has counted these times, (N,)."""
        times_s = clock_s
        for _ in range(3):  # each iteration gains a factor of 1e4
            times_s = times_s - (self.clock_s(times_s) - clock_s)
        return times_s
