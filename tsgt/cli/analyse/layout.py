"""The command ``analyse layout``: expected pose accuracy of prism layouts and station positions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.design import (
    LayoutProblem,
    PoseAccuracy,
    RobotPoses,
    Station,
    optimal_layout,
    pose_covariances,
    station_arrangements,
)
from tsgt.cli.analyse.options import figure_option, read_layout, usable_layout
from tsgt.cli.options import FiniteRange, json_option, path_type
from tsgt.cli.output import print_json, print_table
from tsgt.cli.progress import progress
from tsgt.config import MasterConfig, load, parameters, scenario_parameters
from tsgt.errors import ConfigError
from tsgt.model import MAX_COORDINATE_M
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.design import Criterion
    from tsgt.config import ScenarioConfig
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters, Vector3

_DISTANCES_M = (25.0, 50.0, 100.0, 200.0, 400.0)
_BEST = "best in the envelope"


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A layout and the covariances of its poses."""

    name: str
    layout: FloatArray
    covariance: FloatArray

    @property
    def figures(self) -> PoseAccuracy:
        return PoseAccuracy.of(self.covariance)


@click.command()
@click.argument("layouts", type=path_type, nargs=-1)
@click.option(
    "--scenario",
    "scenario_name",
    help="Scenario with stations, their noise, prisms and area: name, or path of a file.  [default: dynamic]",
)
@click.option(
    "--config",
    "config_path",
    type=path_type,
    help="Configuration of a master (TOML) instead of a scenario. Needs --area.",
)
@click.option(
    "--area",
    type=(float, float, float, float),
    metavar="X Y Z RADIUS",
    help="Area of the drive, in the frame of station 1 in m.  [default: that of the scenario]",
)
@click.option(
    "--envelope",
    type=(float, float, float, float, float, float),
    metavar="XMIN XMAX YMIN YMAX ZMIN ZMAX",
    help="Box in the robot frame, in m, in which to search for the best layout.",
)
@click.option(
    "--min-separation-mm",
    type=FiniteRange(10, 10_000),
    default=300.0,
    help="Minimum distance of two prisms in the envelope, so that instruments can distinguish them.",
)
@click.option(
    "--objective",
    "criterion",
    type=click.Choice(["rotation", "position"]),
    default="rotation",
    help="Accuracy to optimise.",
)
@click.option(
    "--point",
    "point_m",
    type=(float, float, float),
    metavar="X Y Z",
    default=(0.0, 0.0, 0.0),
    help="Point whose position accuracy counts, in the robot frame in m, for example of a sensor.",
)
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the search.")
@figure_option
@json_option
def layout_command(
    *,
    layouts: tuple[Path, ...],
    scenario_name: str | None,
    config_path: Path | None,
    area: tuple[float, float, float, float] | None,
    envelope: tuple[float, ...] | None,
    min_separation_mm: float,
    criterion: Criterion,
    point_m: Vector3,
    seed: int,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Rank prism layouts by expected pose accuracy.

    LAYOUTS are set-up files; that of the scenario or configuration is ranked with them. The level robot is placed at
    several positions and headings, each station measures its prism once, and the instrument noise is propagated to the
    pose to first order. Then the stations are moved, to show the effect of their distance, and of placing them together
    or around the robot.
    """
    # Comparisons with NaN are false.
    if not all(
        abs(number_m) <= MAX_COORDINATE_M for number_m in (*(area or ()), *(envelope or ()), *point_m)
    ):
        raise click.UsageError(
            f"--area, --envelope and --point need finite numbers, at most {MAX_COORDINATE_M:g} m"
        )
    known, places, source = _setup(scenario_name, config_path, area)
    slots = {prism: slot for slot, prism in enumerate(sorted({s.prism for s in known.stations}))}
    stations = tuple(
        Station(np.array(s.T_station1_station)[:3, 3], s.noise, slots[s.prism]) for s in known.stations
    )
    robot_poses, point = RobotPoses.at(places), np.array(point_m)
    wanted = {source: _tracked({p.prism: p.position_m for p in known.prisms}, slots, source)}
    for path in layouts:
        wanted[str(path)] = _tracked(read_layout(path), slots, path)

    def candidate(name: str, layout: FloatArray) -> _Candidate:
        return _Candidate(name, layout, pose_covariances(layout, stations, robot_poses, point))

    candidates = [candidate(name, np.array(list(prisms.values()))) for name, prisms in wanted.items()]
    if envelope is not None:
        task = LayoutProblem(
            envelope_m=_box(envelope),
            count=len(slots),
            min_separation_m=min_separation_mm / 1e3,
            criterion=criterion,
            stations=stations,
            robot_poses=robot_poses,
            point_m=point,
        )
        with progress("searching") as on_progress:
            found = optimal_layout(task, np.random.default_rng(seed), on_progress=on_progress)
        candidates.append(candidate(_BEST, found))
    candidates.sort(key=lambda c: c.figures.rotation_rad if criterion == "rotation" else c.figures.position_m)
    centre = places.mean(axis=0)
    distances = {d: _by_arrangement(candidates[0], stations, centre, d, point) for d in _DISTANCES_M}
    if figure is not None:
        from tsgt.analysis.figures import draw_layouts

        draw_layouts({c.name: c.covariance for c in candidates}, distances, point, figure)
    if as_json:
        print_json(
            {
                "by": criterion,
                "point_m": point.tolist(),
                "stances": len(robot_poses.position_m),
                "ranking": [each.name for each in candidates],
                "layouts": {
                    c.name: {"prisms": dict(zip(slots, c.layout.tolist(), strict=True)), **_keys(c.figures)}
                    for c in candidates
                },
                "stations_at_m": {
                    f"{d:g}": {name: _keys(each) for name, each in found.items()}
                    for d, found in distances.items()
                },
            }
        )
        return
    _print(candidates, point, len(robot_poses.position_m))
    if envelope is not None:
        _print_best(next(c for c in candidates if c.name == _BEST), slots)
    _print_distances(candidates[0].name, distances)


def _setup(
    scenario_name: str | None, config_path: Path | None, area: tuple[float, ...] | None
) -> tuple[Parameters, FloatArray, str]:
    """Return the parameters, the places of the robot, (M, 3), and the name of their source."""
    if config_path is not None:
        if scenario_name is not None:
            raise click.UsageError("--scenario and --config exclude each other")
        if area is None:
            raise click.UsageError(
                "--config needs --area: a configuration does not define the area of the drive"
            )
        return parameters(load(config_path, MasterConfig)), _places(area), str(config_path)
    scenario = find_scenario(scenario_name or "dynamic")
    places = _places(area) if area is not None else _scenario_places(scenario)
    return scenario_parameters(scenario), places, scenario.name


def _scenario_places(scenario: ScenarioConfig) -> FloatArray:
    motion = scenario.motion
    if motion.route_m:
        return np.array(motion.route_m)
    return _places((*motion.area_centre_m, motion.area_radius_m))


def _places(area: Sequence[float]) -> FloatArray:
    """Return the centre of an area and four places on the circle that halves it."""
    x, y, z, radius = area
    if radius < 0:
        raise click.UsageError("--area: the radius is below zero")
    r = radius / math.sqrt(2)
    return np.array([[x, y, z], [x + r, y, z], [x, y + r, z], [x - r, y, z], [x, y - r, z]])


def _tracked(
    layout: Mapping[int, Vector3], slots: Mapping[int, int], source: Path | str
) -> Mapping[int, Vector3]:
    """Return the prisms of a layout that the stations track."""
    for prism in slots:
        if prism not in layout:
            raise ConfigError(
                f"{source}: prisms.{prism}: missing; a station tracks it", key=f"prisms.{prism}"
            )
    return usable_layout({prism: layout[prism] for prism in slots}, source)


def _box(envelope: tuple[float, ...]) -> FloatArray:
    box = np.array(envelope).reshape(3, 2).T
    if np.any(box[0] > box[1]):
        raise click.UsageError("--envelope: a minimum is above its maximum")
    return box


def _by_arrangement(
    candidate: _Candidate,
    stations: tuple[Station, ...],
    centre: FloatArray,
    distance_m: float,
    point: FloatArray,
) -> dict[str, PoseAccuracy]:
    robot_poses = RobotPoses.at(centre[None])
    return {
        name: PoseAccuracy.of(pose_covariances(candidate.layout, moved, robot_poses, point))
        for name, moved in station_arrangements(stations, centre, distance_m).items()
    }


def _keys(figures: PoseAccuracy) -> dict[str, Any]:
    return {
        "position_sigma_mm": 1e3 * figures.position_m,
        "position_axes_sigma_mm": (1e3 * figures.position_axes_m).tolist(),
        "worst_position_sigma_mm": 1e3 * figures.worst_position_m,
        "rotation_sigma_mrad": 1e3 * figures.rotation_rad,
        "rotation_axes_sigma_mrad": (1e3 * figures.rotation_axes_rad).tolist(),
        "worst_rotation_sigma_mrad": 1e3 * figures.worst_rotation_rad,
    }


def _print(candidates: Sequence[_Candidate], point: FloatArray, robot_poses: int) -> None:
    x, y, z = point
    click.echo(
        f"One measurement of each prism, the robot stationary: one sigma, root mean square over {robot_poses} places and\n"
        f"headings, of the position of ({x:g}, {y:g}, {z:g}) m and of the rotation (mm, mrad)\n"
    )
    rows = [
        [
            candidate.name,
            *_thousandths(f.position_m, *f.position_axes_m, f.worst_position_m),
            *_thousandths(f.rotation_rad, *f.rotation_axes_rad, f.worst_rotation_rad),
        ]
        for candidate in candidates
        for f in [candidate.figures]
    ]
    print_table(["layout", "position", *"xyz", "worst", "rotation", "roll", "pitch", "yaw", "worst"], rows)


def _print_best(found: _Candidate, slots: Mapping[int, int]) -> None:
    click.echo("\nBest layout in the envelope, as in a prism layout file\n")
    for prism, slot in slots.items():
        x, y, z = found.layout[slot]
        click.echo(f"  [prisms.{prism}]\n  position_m = [{x:.3f}, {y:.3f}, {z:.3f}]")


def _print_distances(name: str, distances: Mapping[float, Mapping[str, PoseAccuracy]]) -> None:
    click.echo(f"\nOther station positions, with {name}, for the same point (mm, mrad)\n")
    rows = []
    for distance_m, found in distances.items():
        figures = [value for f in found.values() for value in (f.position_m, f.rotation_rad)]
        rows.append([f"{distance_m:g} m", *_thousandths(*figures)])
    header = [f"{what}, {how}" for how in next(iter(distances.values())) for what in ("position", "rotation")]
    print_table(["distance", *header], rows)


def _thousandths(*values: float) -> list[str]:
    """Return table cells: mm of m, mrad of rad."""
    return [f"{1e3 * value:.2f}" for value in values]
