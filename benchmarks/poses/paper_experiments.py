"""The experiments of the founding paper, simulated: quarry, ski trail (three drives), snowmobile trail.

Each drive is run with the real daemons on virtual time and judged with the functions of ``tsgt evaluate``: distances between
prisms, standing and driving, and poses against the truth, three times over:

- ``paper``: protocol classic with our client, estimator linear;
- ``letter``: the same with nodes as the authors deployed them and the paper's clock filter, at 10 ppm of drift;
- ``ours``: protocol superframe, estimator continuous.

    python benchmarks/run.py paper_experiments [--experiment NAME]... [--json]

What the figures mean stands in docs/explanation/paper-experiments.md.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from measuring import simulated

from tsgt.analysis.evaluation import (
    PairDistances,
    PoseErrors,
    Reference,
    distances_at_epochs,
    inter_prism,
    interior_mask,
    pose_errors,
    stationary_errors,
)
from tsgt.analysis.evaluation.reference import StationaryErrors
from tsgt.analysis.processing import process, with_estimator
from tsgt.cli.output import print_json
from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.estimation import build_tracks
from tsgt.geometry import quaternion_from_rotation, rotation_from_quaternion, transform_from
from tsgt.log import configure_logging
from tsgt.recording import load_recording
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from tsgt.simulation.mission import MissionResult

EXPERIMENTS = {"quarry": (0,), "ski-trail": (0, 1, 2), "snowmobile": (0,)}
"""Seeds of the drives, by scenario: the paper drove the ski trail three times."""

SYSTEMS = ("paper", "letter", "ours")


@dataclasses.dataclass(frozen=True)
class Drive:
    """What one drive, or several together, came to.

    Attributes
    ----------
    static, dynamic, moving
        Distances by pair: raw while standing; at 20 Hz over the whole way; the same without the stops.
    poses, valid_poses
        Epochs, and valid ones among them.
    errors
        Of the valid poses against the truth.
    stops
        Of the mean pose of each stop against the truth.
    """

    static: tuple[PairDistances, ...]
    dynamic: tuple[PairDistances, ...]
    moving: tuple[PairDistances, ...]
    poses: int
    valid_poses: int
    errors: PoseErrors
    stops: StationaryErrors


def drive(experiment: str, system: str, seed: int) -> Drive:
    """Simulate one drive, and evaluate its recording."""
    configure_logging("error")
    scenario = find_scenario(experiment)
    # What is recorded does not depend on the estimator that runs live; this one is the faster.
    pipeline = scenario.pipeline.model_copy(update={"estimator": "linear"})
    scenario = scenario.model_copy(update={"pipeline": pipeline})
    options = SimulationOptions(
        duration_s=scenario.duration_s,
        seed=seed,
        station_software="authors" if system == "letter" else "ours",
        protocol=SuperframeMasterConfig(kind="superframe")
        if system == "ours"
        else ClassicMasterConfig(
            kind="classic", clock_filter="paper" if system == "letter" else "regression"
        ),
    )
    with simulated(scenario, options) as run:
        path = run.master_logs[-1].recording()
        if path is None:
            raise RuntimeError(f"{experiment}, {system}: the master made no recording")
        recording = load_recording(path)
    recording = with_estimator(recording, "continuous" if system == "ours" else "linear")
    poses = process(recording, path=path)
    parameters = recording.parameters
    tracks = build_tracks(parameters, recording.measurements)
    epochs = distances_at_epochs(parameters, tracks)
    found = inter_prism(parameters, tracks, found=epochs)
    moving = epochs.valid.copy()
    for start_ns, end_ns in found.stationary_ns:
        moving &= (epochs.stamp_ns < start_ns) | (epochs.stamp_ns > end_ns)
    truth, centroid_m = truth_of(run), run.world.prisms_m.mean(axis=0)
    rows = np.flatnonzero(poses.valid & interior_mask(poses.stamp_ns, run.start_ns, run.end_ns))
    turns = rotation_from_quaternion(poses.orientation_xyzw[rows])
    true = run.world.pose_at((poses.stamp_ns[rows] - run.start_ns) / 1e9)
    return Drive(
        static=found.static,
        dynamic=found.dynamic,
        moving=tuple(
            PairDistances(pair, distances[moving], epochs.references_m[pair], int(np.sum(~moving)))
            for pair, distances in epochs.distances_m.items()
        ),
        poses=len(poses),
        valid_poses=int(np.count_nonzero(poses.valid)),
        errors=pose_errors(transform_from(turns, poses.position_m[rows]), true, centroid_m),
        stops=stationary_errors(poses, truth, found.stationary_ns, centroid_m),
    )


def truth_of(run: MissionResult) -> Reference:
    """Return the true poses at 20 Hz."""
    stamps = np.arange(run.start_ns, run.end_ns + 1, 50_000_000, dtype=np.int64)
    poses = run.world.pose_at((stamps - run.start_ns) / 1e9)
    return Reference(stamps, poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]))


def together(drives: list[Drive]) -> Drive:
    """Put all drives of one experiment together: each distance and each pose counts once."""

    def joined(name: str) -> tuple[PairDistances, ...]:
        columns = zip(*(getattr(each, name) for each in drives), strict=True)
        return tuple(
            dataclasses.replace(
                column[0],
                distances_m=np.concatenate([pair.distances_m for pair in column]),
                invalid=sum(pair.invalid for pair in column),
            )
            for column in columns
        )

    def arrays(kind: Any, name: str) -> Any:
        parts = [dataclasses.astuple(getattr(each, name)) for each in drives]
        return kind(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    return Drive(
        static=joined("static"),
        dynamic=joined("dynamic"),
        moving=joined("moving"),
        poses=sum(each.poses for each in drives),
        valid_poses=sum(each.valid_poses for each in drives),
        errors=arrays(PoseErrors, "errors"),
        stops=arrays(StationaryErrors, "stops"),
    )


def keys(found: Drive) -> dict[str, Any]:
    """Put the figures under their names, for ``--json``; those of ``tsgt evaluate`` have the same."""

    def pairs(some: tuple[PairDistances, ...]) -> dict[str, Any]:
        errors_mm = 1e3 * np.concatenate([np.abs(p.distances_m - p.reference_m) for p in some])
        return {
            **{pair.name: dataclasses.asdict(pair.statistics()) for pair in some},
            "all": {
                "mean_abs_error": float(errors_mm.mean()) if len(errors_mm) else None,
                "std_abs_error": float(errors_mm.std()) if len(errors_mm) else None,
                "valid": len(errors_mm),
            },
        }

    return {
        "reference_point": "robot",
        "inter_prism_static_mm": pairs(found.static),
        "inter_prism_mm": pairs(found.dynamic),
        "inter_prism_moving_mm": pairs(found.moving),
        "poses": found.poses,
        "valid_poses": found.valid_poses,
        "position_rms_mm": found.errors.position_rms_mm,
        "orientation_rms_deg": found.errors.orientation_rms_deg,
        "centroid": dataclasses.asdict(found.errors.centroid),
        "stationary": dataclasses.asdict(found.stops.statistics()),
    }


def row(experiment: str, system: str, found: dict[str, Any]) -> str:
    """Write one row of the table."""
    static = {pair: f for pair, f in found["inter_prism_static_mm"].items() if pair != "all"}
    whole, moving, stops = (
        found["inter_prism_mm"]["all"],
        found["inter_prism_moving_mm"]["all"],
        found["stationary"],
    )

    def number(value: float | None, digits: int) -> str:
        return "-" if value is None or np.isnan(value) else f"{value:.{digits}f}"

    cells = [
        f"{experiment}, `{system}`",
        str(sum(f["valid"] for f in static.values())),
        " / ".join(number(abs(f["mean"] - f["reference"]), 2) for f in static.values()),
        " / ".join(number(f["std"], 1) for f in static.values()),
        f"{number(whole['mean_abs_error'], 1)} ± {number(whole['std_abs_error'], 1)}",
        number(moving["mean_abs_error"], 1),
        f"{stops['stops']}: {number(stops['centroid']['position_mean_mm'], 2)}, {number(stops['rotation_mean_deg'], 3)}",
        f"{number(found['centroid']['position_rms_mm'], 1)}, {number(found['orientation_rms_deg'], 2)}",
        f"{found['valid_poses'] / found['poses']:.0%}",
    ]
    return f"| {' | '.join(cells)} |"


HEADER = (
    "| experiment | static distances | their mean off by 1-2 / 1-3 / 2-3 (mm) | std (mm) | error at 20 Hz (mm) "
    "| the same without stops | stops: mean pose off by (mm at the centroid, degrees) | poses, rms (mm at the centroid, degrees) | valid |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


@click.command()
@click.option(
    "--experiment", "experiments", type=click.Choice(list(EXPERIMENTS)), multiple=True, help="Only this one."
)
@click.option("--system", "systems", type=click.Choice(SYSTEMS), multiple=True, help="Only this one.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Processes.")
@click.option("--json", "as_json", is_flag=True, help="Print all figures as JSON.")
def main(experiments: tuple[str, ...], systems: tuple[str, ...], jobs: int, *, as_json: bool) -> None:
    """Run all drives and print a table."""
    began_s = time.perf_counter()
    asked = [
        (experiment, system, seed)
        for experiment in experiments or EXPERIMENTS
        for system in systems or SYSTEMS
        for seed in EXPERIMENTS[experiment]
    ]
    done: dict[tuple[str, str, int], Drive] = {}
    with (
        ProcessPoolExecutor(jobs) as pool,
        click.progressbar(length=len(asked), label="driving", file=sys.stderr) as bar,
    ):
        futures = {pool.submit(drive, *one): one for one in asked}
        for future in as_completed(futures):
            done[futures[future]] = future.result()
            bar.update(1)
    result: dict[str, dict[str, Any]] = {}
    for experiment, system, _ in asked:
        drives = [found for (e, s, _), found in sorted(done.items()) if (e, s) == (experiment, system)]
        result.setdefault(experiment, {})[system] = keys(together(drives))
    if as_json:
        print_json({"experiments": result, "seconds": time.perf_counter() - began_s})
        return
    click.echo(HEADER)
    for experiment, by_system in result.items():
        for system, found in by_system.items():
            click.echo(row(experiment, system, found))
