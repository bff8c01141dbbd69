"""The site of the rehearsal: three stations around a small yard, four targets, and a radio that is legal where it claims to be."""

from __future__ import annotations

from tsgt.config import MotionConfig, ScenarioConfig, ScenarioRadioConfig, SimulatedStation

REGION = "CA915"

TARGETS = 4

SCENARIO = ScenarioConfig(
    name="rehearsal",
    motion=MotionConfig(start_after_s=2.0, area_centre_m=(24.0, 14.0, -1.0), area_radius_m=10.0),
    stations=(
        SimulatedStation(station=1, prism=1, position_m=(0.0, 0.0, 0.0)),
        SimulatedStation(station=2, prism=2, position_m=(9.0, -6.0, 0.1), yaw_deg=25.0),
        SimulatedStation(station=3, prism=3, position_m=(-3.0, 11.0, -0.2), yaw_deg=-70.0),
    ),
    targets_m=((38.0, -4.0, 1.5), (41.0, 27.0, -0.5), (8.0, 33.0, 2.0), (-14.0, -9.0, 0.5)),
    # A channel of 500 kHz may have this power in Canada and the USA. Its packets are short: frames have room for the delays of
    # a busy computer.
    radio=ScenarioRadioConfig(bandwidth_khz=500.0, spreading_factor=8, power_dbm=17),
)

MOVED_TRIPOD = SimulatedStation(station=2, prism=2, position_m=(9.12, -6.08, 0.1), yaw_deg=25.3)
"""Station 2 after somebody has lifted its tripod out of his way and put it back: 144 mm and 5 mrad."""
