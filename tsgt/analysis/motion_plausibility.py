"""Whether a tuned motion prior suits live estimation, which must also predict the next drive. Sans-I/O.

A smoothed pose lies between measurements and hardly needs the prior; a predicted one is nothing else. A prior that fits one
recording best may describe its vibration, or its one manoeuvre, and not what the robot does next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.analysis.smoothing import SmoothedPoses
    from tsgt.model import MotionPrior

CORRELATION_TIME_S = (0.1, 5.0)
"""Drives and suspension of a wheeled or tracked robot need a tenth of a second or more to build up an acceleration. Nobody
accelerates, brakes or turns harder and harder for longer than some seconds: 5 s at 1 m/s^2 are 18 km/h."""

MAX_ACCELERATION_MPS2 = 4.0  # One sigma; tyres and tracks hold 5 to 8 at most
MAX_ANGULAR_ACCELERATION_RADPS2 = 5.0  # One sigma: from rest to 90 degrees per second in a third of a second
MIN_MOTION_S = 60.0  # Of a drive that shows what a robot does: a dozen manoeuvres


def unfit_for_live(found: SmoothedPoses) -> list[str]:
    """Return why the motion prior that was tuned to a recording should not be used live; empty where it may be."""
    if not found.motion.tuned:
        return []
    time_s = found.observations.time_s
    return implausibilities(found.motion.prior, moving_s=float(time_s[-1] - time_s[0]) - found.rest_s)


def implausibilities(prior: MotionPrior, *, moving_s: float) -> list[str]:
    """Return why a prior tuned to a drive with ``moving_s`` of motion should not be used live; empty where it may be."""
    shortest_s, longest_s = CORRELATION_TIME_S
    reasons = []
    for time_s, name in (
        (prior.acceleration_correlation_time_s, "acceleration"),
        (prior.angular_acceleration_correlation_time_s, "angular acceleration"),
    ):
        if time_s < shortest_s:
            reasons.append(
                f"the {name} is correlated over {time_s:.2g} s, less than the {shortest_s:g} s in which a vehicle's drive acts: "
                "this is vibration"
            )
        elif time_s > longest_s:
            reasons.append(
                f"the {name} is correlated over {time_s:.2g} s, longer than any manoeuvre ({longest_s:g} s): the recording does "
                "not determine it"
            )
    for sigmas, limit, name, unit in (
        (prior.acceleration_sigma_mps2, MAX_ACCELERATION_MPS2, "acceleration", "m/s^2"),
        (
            prior.angular_acceleration_sigma_radps2,
            MAX_ANGULAR_ACCELERATION_RADPS2,
            "angular acceleration",
            "rad/s^2",
        ),
    ):
        if max(sigmas) > limit:
            reasons.append(
                f"one sigma of the {name} is {max(sigmas):.2g} {unit}, more than a vehicle does ({limit:g} {unit})"
            )
    if moving_s < MIN_MOTION_S:
        reasons.append(f"the robot moved for {moving_s:.0f} s only; {MIN_MOTION_S:.0f} s are needed")
    return reasons
