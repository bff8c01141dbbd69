"""The command ``analyse layout``: expected pose accuracy of prism layouts and station positions."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.design import (
    DrivenPath,
    InertialAccuracy,
    LayoutProblem,
    PoseAccuracy,
    RobotPoses,
    Station,
    inertial_accuracy,
    optimal_layout,
    pose_covariances,
    station_arrangements,
)
from tsgt.analysis.text_file import utf8_name
from tsgt.cli.analyse.options import figure_option, point_text, read_layout, usable_layout
from tsgt.cli.options import FiniteRange, json_option, path_type, point_option, resolved_point
from tsgt.cli.output import print_json, print_table
from tsgt.cli.progress import progress
from tsgt.config import IMU_NOISE, MasterConfig, load, parameters, scenario_parameters
from tsgt.errors import ConfigError
from tsgt.model import MAX_COORDINATE_M, MIN_PRISMS, ImuParameters
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.design import Criterion
    from tsgt.config import ImuModelName
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters, ReferencePoint, Vector3

_DISTANCES_M = (25.0, 50.0, 100.0, 200.0, 400.0)
_BEST = "best in the envelope"


@dataclass(frozen=True, slots=True)
class _Setup:
    """What is studied: ``places``, (M, 3), of the robot, in the order of a ``route`` or not."""

    known: Parameters
    imu: ImuParameters | None
    places: FloatArray
    route: bool
    source: str


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
@point_option("that of the scenario or configuration, else the robot's origin")
@click.option(
    "--imu",
    "imu_class",
    type=click.Choice(list(IMU_NOISE)),
    help="Class of the robot's IMU, to show what each station adds to it.  [default: that of the scenario or configuration]",
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
    point: ReferencePoint | str | None,
    imu_class: ImuModelName | None,
    seed: int,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Rank prism layouts by expected pose accuracy.

    LAYOUTS are set-up files; that of the scenario or configuration is ranked with them. The level robot is placed at
    several positions and headings, each station measures its prism once, and the instrument noise is propagated to the
    pose to first order. Then the stations are moved, to show the effect of their distance, and of placing them together
    or around the robot.

    With an IMU the robot drives through the area, and the accuracy of smoothed and of live poses is shown with the first
    station alone, with two, and so on. Fewer than three prisms have this table only.
    """
    # Comparisons with NaN are false.
    if not all(abs(number_m) <= MAX_COORDINATE_M for number_m in (*(area or ()), *(envelope or ()))):
        raise click.UsageError(f"--area and --envelope need finite numbers, at most {MAX_COORDINATE_M:g} m")
    setup = _setup(scenario_name, config_path, area, imu_class)
    known, places, source = setup.known, setup.places, setup.source
    at = known.reference_point if point is None else resolved_point(point, known)
    slots = {prism: slot for slot, prism in enumerate(sorted({s.prism for s in known.stations}))}
    stations = tuple(
        Station(np.array(s.T_station1_station)[:3, 3], s.noise, slots[s.prism]) for s in known.stations
    )
    robot_poses, point_m = RobotPoses.at(places), np.array(at.position_m)
    if setup.imu is not None and len(slots) < MIN_PRISMS:
        if layouts or envelope is not None or figure is not None:
            raise click.UsageError(
                f"LAYOUTS, --envelope and --figure need {MIN_PRISMS} tracked prisms, the stations track {len(slots)}"
            )
        positions = {prism.prism: prism.position_m for prism in known.prisms}
        layout = np.array([positions[prism] for prism in slots])
        added = _by_stations(layout, stations, setup, setup.imu, point_m)
        if as_json:
            print_json({"reference_point": dataclasses.asdict(at), "with_imu": _imu_keys(added)})
        else:
            _print_stations(added, at, source)
        return
    wanted = {source: _tracked({p.prism: p.position_m for p in known.prisms}, slots, source)}
    for path in layouts:
        wanted[utf8_name(str(path))] = _tracked(read_layout(path), slots, path)

    def candidate(name: str, layout: FloatArray) -> _Candidate:
        return _Candidate(name, layout, pose_covariances(layout, stations, robot_poses, point_m))

    candidates = [candidate(name, np.array(list(prisms.values()))) for name, prisms in wanted.items()]
    if envelope is not None:
        task = LayoutProblem(
            envelope_m=_box(envelope),
            count=len(slots),
            min_separation_m=min_separation_mm / 1e3,
            criterion=criterion,
            stations=stations,
            robot_poses=robot_poses,
            point_m=point_m,
        )
        with progress("searching") as on_progress:
            found = optimal_layout(task, np.random.default_rng(seed), on_progress=on_progress)
        candidates.append(candidate(_BEST, found))
    candidates.sort(key=lambda c: c.figures.rotation_rad if criterion == "rotation" else c.figures.position_m)
    centre = places.mean(axis=0)
    distances = {d: _by_arrangement(candidates[0], stations, centre, d, point_m) for d in _DISTANCES_M}
    added = (
        {} if setup.imu is None else _by_stations(candidates[0].layout, stations, setup, setup.imu, point_m)
    )
    if figure is not None:
        from tsgt.analysis.figures import draw_layouts

        draw_layouts({c.name: c.covariance for c in candidates}, distances, at, figure)
    if as_json:
        print_json(
            {
                "objective": criterion,
                "reference_point": dataclasses.asdict(at),
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
                **({"with_imu": _imu_keys(added)} if added else {}),
            }
        )
        return
    _print(candidates, at, len(robot_poses.position_m))
    if envelope is not None:
        _print_best(next(c for c in candidates if c.name == _BEST), slots)
    _print_distances(candidates[0].name, distances)
    if added:
        click.echo()
        _print_stations(added, at, candidates[0].name)


def _setup(
    scenario_name: str | None,
    config_path: Path | None,
    area: tuple[float, ...] | None,
    imu_class: ImuModelName | None,
) -> _Setup:
    if config_path is not None:
        if scenario_name is not None:
            raise click.UsageError("--scenario and --config exclude each other")
        if area is None:
            raise click.UsageError(
                "--config needs --area: a configuration does not define the area of the drive"
            )
        known = parameters(load(config_path, MasterConfig))
        imu = known.imu
        if imu_class is not None:
            imu = ImuParameters(
                position_m=(0.0, 0.0, 0.0) if imu is None else imu.position_m,
                orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
                noise=IMU_NOISE[imu_class],
            )
        return _Setup(known, imu, _places(area), route=False, source=utf8_name(str(config_path)))
    scenario = find_scenario(scenario_name or "dynamic")
    if imu_class is not None:
        simulated = scenario.imu.model_copy(update={"model": imu_class})
        scenario = scenario.model_copy(update={"imu": simulated})
    known = scenario_parameters(scenario, imu=True)
    imu = known.imu
    route_m = scenario.motion.route_m
    if area is None and route_m:
        return _Setup(known, imu, np.array(route_m), route=True, source=scenario.name)
    motion = scenario.motion
    places = _places(area or (*motion.area_centre_m, motion.area_radius_m))
    return _Setup(known, imu, places, route=False, source=scenario.name)


def _by_stations(
    layout: FloatArray,
    stations: tuple[Station, ...],
    setup: _Setup,
    imu: ImuParameters,
    point_m: FloatArray,
) -> dict[int, InertialAccuracy]:
    """Return the accuracy with the IMU and the first stations, by their number."""
    path = DrivenPath.through(setup.places, closed=not setup.route)
    return {
        count: inertial_accuracy(layout, stations[:count], path, imu, point_m)
        for count in range(1, len(stations) + 1)
    }


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
    point_m: FloatArray,
) -> dict[str, PoseAccuracy]:
    robot_poses = RobotPoses.at(centre[None])
    return {
        name: PoseAccuracy.of(pose_covariances(candidate.layout, moved, robot_poses, point_m))
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


def _print(candidates: Sequence[_Candidate], point: ReferencePoint, robot_poses: int) -> None:
    click.echo(
        f"One measurement of each prism, the robot stationary: one sigma, root mean square over {robot_poses} places and\n"
        f"headings, of the position of {point_text(point)} and of the rotation (mm, mrad)\n"
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


def _imu_keys(added: Mapping[int, InertialAccuracy]) -> dict[str, Any]:
    return {
        str(count): {"smoothed": _keys(found.smoothed), "predicted": _keys(found.predicted)}
        for count, found in added.items()
    }


def _print_stations(added: Mapping[int, InertialAccuracy], point: ReferencePoint, name: str) -> None:
    click.echo(
        f"With the IMU and the first stations, with {name}, driving through the area: one sigma, root mean square, of the\n"
        f"position of {point_text(point)} and of the rotation, smoothed afterwards and live (mm, mrad)\n"
    )
    rows = [
        [
            str(count),
            *(
                cell
                for each in (found.smoothed, found.predicted)
                for cell in _thousandths(each.position_m, each.rotation_rad, each.rotation_axes_rad[2])
            ),
        ]
        for count, found in added.items()
    ]
    columns = ["position", "rotation", "yaw"]
    print_table(["stations", *columns, *(f"live {name}" for name in columns)], rows)


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
