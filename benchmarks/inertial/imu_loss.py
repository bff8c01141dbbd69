"""Loss, return and faults of the robot's IMU at random instants, against the same mission without it.

    python benchmarks/run.py imu_loss [--seeds N] [--first SEED] [--duration SECONDS] [--groups losses values knock] [--json FILE]

A mission with three stations is simulated once for each seed, and estimated without IMU and once for each group of faults:

- losses: silences, dropouts and late bursts, one every eight seconds;
- values: values that repeat, clipped values, a jump of the device's clock, one every fifteen seconds, in random order;
- knock: the IMU is turned by 1 degree and moved by 20 mm, once.

Instants, durations and sizes are random, and the first comes once the drive has had time to confirm the set-up. The IMU is
industrial in even seeds, else consumer. From the beginning of each fault until ten seconds after its end (knock: forty), each
valid pose is compared with that of the same kind and epoch without IMU. It is worse if it is farther from the truth in position
(at the prisms' centroid) or rotation, and beyond what its covariance allows while the other one is not (NEES of 22.5, which one
in a thousand honest poses exceeds). The takeover is timed from the first sample that the fault changes to the first predicted
pose that does not rest on the IMU, ten of them a second; a fault that poses outlive on the IMU has none.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.inertial.imu_faults import Drive, Poses

from tsgt.log import configure_logging
from tsgt.simulation.faults import Fault, FaultKind, imu_conditions
from tsgt.simulation.imu import Saturation, simulate_imu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.simulation.imu import ImuCondition

GROUPS = {
    "losses": (FaultKind.IMU_SILENCE, FaultKind.IMU_DROPOUT, FaultKind.IMU_LATE_BURST),
    "values": (FaultKind.IMU_STUCK, FaultKind.IMU_SATURATION, FaultKind.IMU_CLOCK_JUMP),
    "knock": (FaultKind.IMU_KNOCK,),
}
DURATIONS_S = {
    FaultKind.IMU_SILENCE: (0.05, 5.0),
    FaultKind.IMU_DROPOUT: (0.5, 5.0),
    FaultKind.IMU_LATE_BURST: (0.05, 3.0),
    FaultKind.IMU_STUCK: (0.15, 5.0),
    FaultKind.IMU_SATURATION: (0.5, 5.0),
}
INTERVAL_S = {"losses": 8.0, "values": 15.0, "knock": 60.0}
START_S = 32.0
AFTER_S = {"losses": 10.0, "values": 10.0, "knock": 40.0}
MAX_NEES = 22.46


@dataclass
class Event:
    """A fault, and what came of it; times in s."""

    seed: int
    kind: str
    at_s: float
    duration_s: float
    effect_s: float | None  # of the first sample that it changes; None: it changes none
    takeover_s: float | None = (
        None  # from there; None: the poses went on resting on the IMU, or did not before
    )
    used_before: bool = False
    valid_after_s: float | None = (
        None  # from the effect to the first valid pose that does not rest on the IMU
    )
    back_s: float | None = None  # from the end to the first pose that rests on it again


@dataclass
class Compared:
    """Poses of both missions at the same epochs, (N,) each; errors without IMU are NaN where it had no valid pose."""

    position_m: NDArray[np.float64]
    rotation_rad: NDArray[np.float64]
    nees: NDArray[np.float64]
    other_position_m: NDArray[np.float64]
    other_rotation_rad: NDArray[np.float64]
    other_nees: NDArray[np.float64]
    predicted: NDArray[np.bool_]
    time_s: NDArray[np.float64]
    only_without: int  # epochs at which only the mission without IMU has a valid pose

    @property
    def worse(self) -> NDArray[np.bool_]:
        """Which poses are farther from the truth than without IMU, and beyond their covariance, which the others are not."""
        farther = (self.position_m > self.other_position_m) | (self.rotation_rad > self.other_rotation_rad)
        alone = np.isnan(self.other_nees)
        found: NDArray[np.bool_] = (self.nees > MAX_NEES) & (
            alone | (farther & (self.other_nees <= MAX_NEES))
        )
        return found


def draw(group: str, rng: np.random.Generator, duration_s: float) -> list[Fault]:
    """Draw the faults of a group, one after the other."""
    kinds = list(GROUPS[group])
    found: list[Fault] = []
    start_s = START_S
    while start_s + INTERVAL_S[group] <= duration_s or not found:
        if len(found) % len(kinds) == 0:
            rng.shuffle(kinds)
        kind = kinds[len(found) % len(kinds)]
        low, high = np.log(DURATIONS_S.get(kind, (1e-9, 1e-9)))
        lasts_s = float(np.exp(rng.uniform(low, high))) if kind in DURATIONS_S else 0.0
        at_s = start_s + float(rng.uniform(0.0, 2.0 if group != "knock" else 15.0))
        found.append(Fault(at_s, kind, None, lasts_s, int(rng.integers(2**63))))
        start_s += INTERVAL_S[group]
    return found


def effect_s(drive: Drive, fault: Fault, condition: ImuCondition) -> float | None:
    """Time of the first sample that a fault changes."""
    if not isinstance(condition, Saturation):
        return fault.at_s
    run = simulate_imu(
        drive.imu, drive.result.world.motion_at, fault.at_s + fault.duration_s, seed=[drive.seed]
    )
    samples = run.samples.select(run.samples.end_s >= fault.at_s)
    clipped = np.abs(samples.angular_rate_radps).max(axis=1) > condition.angular_rate_radps
    clipped |= np.abs(samples.specific_force_mps2).max(axis=1) > condition.specific_force_mps2
    return float(samples.end_s[np.argmax(clipped)]) if clipped.any() else None


def watch(event: Event, found: Poses) -> None:
    """Fill in when the IMU was left and taken back."""
    if event.effect_s is None:
        return
    predicted = found.select(found.predicted)
    used = predicted.imu == "used"
    before = predicted.time_s < event.effect_s
    event.used_before = bool(before.any() and used[before][-1])
    if not event.used_before:
        return
    ends_s = max(event.at_s + event.duration_s, event.effect_s)
    left = predicted.time_s[~before & ~used & (predicted.time_s < ends_s + 2.0)]
    if not len(left):
        return
    event.takeover_s = float(left[0]) - event.effect_s
    valid = predicted.time_s[~before & ~used & predicted.valid]
    event.valid_after_s = float(valid[0]) - event.effect_s if len(valid) else None
    back = predicted.time_s[used & (predicted.time_s > max(ends_s, float(left[0])))]
    event.back_s = float(back[0]) - ends_s if len(back) else None


def compare(found: Poses, other: Poses, spans_s: Sequence[tuple[float, float]]) -> Compared:
    """Compare poses in some spans."""
    near = np.zeros(len(found.time_s), np.bool_)
    for start_s, end_s in spans_s:
        near |= (found.time_s >= start_s) & (found.time_s < end_s)

    def keys(poses: Poses) -> NDArray[np.int64]:
        return 2 * np.round(poses.time_s * 1e3).astype(np.int64) + poses.predicted

    order = np.argsort(keys(other))
    rows = np.searchsorted(keys(other)[order], keys(found)[near])
    rows = order[np.minimum(rows, len(order) - 1)]
    ours, theirs = found.select(near), other.select(rows)  # type: ignore[arg-type]
    same = keys(ours) == keys(theirs)
    ours, theirs = ours.select(same), theirs.select(same)
    valid = ours.valid
    return Compared(
        ours.position_m[valid],
        ours.rotation_rad[valid],
        ours.nees[valid],
        theirs.position_m[valid],
        theirs.rotation_rad[valid],
        theirs.nees[valid],
        ours.predicted[valid],
        ours.time_s[valid],
        int(np.count_nonzero(~valid & theirs.valid)),
    )


def figures(position_m: NDArray[np.float64], rotation_rad: NDArray[np.float64]) -> str:
    """Rms and 99 % of errors in mm and degrees."""
    rms = 1e3 * np.sqrt(np.mean(position_m**2)), np.degrees(np.sqrt(np.mean(rotation_rad**2)))
    tail = 1e3 * np.quantile(position_m, 0.99), np.degrees(np.quantile(rotation_rad, 0.99))
    return f"{rms[0]:.1f} mm (99 % {tail[0]:.1f}), {rms[1]:.2f} deg (99 % {tail[1]:.2f})"


def report(group: str, parts: list[Compared], events: list[Event]) -> None:
    """Print what came of a group."""
    for predicted in (True, False):
        kind = "predicted" if predicted else "smoothed"

        def joined(name: str, some: bool = predicted) -> NDArray[np.float64]:  # noqa: FBT001
            return np.concatenate([getattr(each, name)[each.predicted == some] for each in parts])

        nees, other = joined("nees"), joined("other_nees")
        both = ~np.isnan(other)
        worse = int(joined("worse").sum())
        print(
            f"{group}, {kind}: {both.sum()} epochs valid in both: with IMU "
            f"{figures(joined('position_m')[both], joined('rotation_rad')[both])}, NEES {nees[both].mean():.1f}, "
            f"above 22.5 {(nees[both] > MAX_NEES).sum()}, above 60 {(nees[both] > 60).sum()}; without "
            f"{figures(joined('other_position_m')[both], joined('other_rotation_rad')[both])}, NEES {other[both].mean():.1f}, "
            f"above 22.5 {(other[both] > MAX_NEES).sum()}, above 60 {(other[both] > 60).sum()}; "
            f"{(~both).sum()} more valid with IMU, of these above 22.5 {(nees[~both] > MAX_NEES).sum()}; worse {worse}"
        )
    print(f"{group}: epochs valid only without IMU: {sum(each.only_without for each in parts)} (both kinds)")
    kinds: dict[str, list[Event]] = defaultdict(list)
    for event in events:
        kinds[event.kind].append(event)
    for kind, some in sorted(kinds.items()):
        used = [each for each in some if each.used_before]
        took = [each.takeover_s for each in used if each.takeover_s is not None]
        valid = [each.valid_after_s for each in used if each.valid_after_s is not None]
        back = [each.back_s for each in used if each.back_s is not None]
        line = f"  {kind}: {len(some)}, {len(used)} while the IMU was used, taken over {len(took)}"
        if took:
            line += f", after {np.median(took):.2f} s, at most {max(took):.2f} s; valid after at most {max(valid, default=np.nan):.2f} s"
            line += f"; {len(back)} times back after {np.median(back) if back else np.nan:.1f} s, at most {max(back, default=np.nan):.1f} s"
        print(line)


def main() -> int:
    """Run the missions."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--duration", type=float, default=100.0)
    parser.add_argument("--groups", nargs="+", choices=list(GROUPS), default=list(GROUPS))
    parser.add_argument("--json", type=Path, help="write the events here, one a line")
    arguments = parser.parse_args()
    configure_logging("critical")
    compared: dict[str, list[Compared]] = defaultdict(list)
    events: dict[str, list[Event]] = defaultdict(list)
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        began_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            mission = Drive.simulated(
                Path(folder),
                seed=seed,
                duration_s=arguments.duration,
                imu="consumer" if seed % 2 else "industrial",
            )
        other = mission.poses([])
        for group in arguments.groups:
            rng = np.random.default_rng([seed, list(GROUPS).index(group), 0x105])
            faults = draw(group, rng, arguments.duration)
            conditions = imu_conditions(faults)
            found = mission.poses(mission.samples(conditions))
            some = []
            for fault, condition in zip(faults, conditions, strict=True):
                at_s = effect_s(mission, fault, condition)
                event = Event(seed, str(fault.kind), fault.at_s, fault.duration_s, at_s)
                watch(event, found)
                some.append(event)
            spans = [(each.at_s, each.at_s + each.duration_s + AFTER_S[group]) for each in some]
            part = compare(found, other, spans)
            events[group] += some
            compared[group].append(part)
            used = (found.imu[found.predicted] == "used").mean()
            print(
                f"seed {seed}, {group}: {len(part.nees)} poses, worse {part.worse.sum()}, wrong {found.wrong.sum()}, IMU used {used:.0%}, "
                f"{time.process_time() - began_s:.0f} s",
                flush=True,
            )
            for row in np.flatnonzero(part.worse)[:6]:
                near = min(some, key=lambda each: abs(part.time_s[row] - each.at_s))
                print(
                    f"     worse at {part.time_s[row]:.2f} s, {'predicted' if part.predicted[row] else 'smoothed'}: "
                    f"{1e3 * part.position_m[row]:.1f} mm, {np.degrees(part.rotation_rad[row]):.2f} deg, NEES {part.nees[row]:.0f}; without "
                    f"{1e3 * part.other_position_m[row]:.1f} mm, {np.degrees(part.other_rotation_rad[row]):.2f} deg, "
                    f"NEES {part.other_nees[row]:.0f}; {near.kind} {near.at_s:.2f}+{near.duration_s:.2f}",
                    flush=True,
                )
            if arguments.json is not None:
                with arguments.json.open("a") as file:
                    file.writelines(json.dumps(asdict(each)) + "\n" for each in some)
    for group in arguments.groups:
        report(group, compared[group], events[group])
    return 0


if __name__ == "__main__":
    main()
