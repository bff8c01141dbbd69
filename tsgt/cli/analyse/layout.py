"""The command ``analyse layout``: where to put prisms and stations, before anybody drives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.design import (
    LayoutFigures,
    Stances,
    Station,
    Task,
    best_layout,
    pose_covariances,
    together_or_around,
)
from tsgt.cli.analyse.options import figure_option, read_layout, usable_layout
from tsgt.cli.options import finite, json_option, path_type
from tsgt.cli.output import print_json, print_table
from tsgt.cli.recordings import progress
from tsgt.config import MasterConfig, load, parameters, scenario_parameters
from tsgt.errors import ConfigError
from tsgt.model import LARGEST_COORDINATE_M
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.design import Criterion
    from tsgt.config import ScenarioConfig
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters, Vector3

_DISTANCES_M = (25.0, 50.0, 100.0, 200.0, 400.0)
_ENVELOPE = "best in the envelope"


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A layout and how well poses from it are known."""

    name: str
    layout: FloatArray
    covariance: FloatArray

    @property
    def figures(self) -> LayoutFigures:
        return LayoutFigures.of(self.covariance)


@click.command()
@click.argument("layouts", type=path_type, nargs=-1)
@click.option(
    "--scenario",
    "scenario_name",
    help="Stations, their noise, prisms, and where the robot drives: name, or path of a file.  [default: dynamic]",
)
@click.option(
    "--config",
    "config_path",
    type=path_type,
    help="Configuration of a master, TOML, instead of a scenario: its stations where they stand. Needs --area.",
)
@click.option(
    "--area",
    type=(float, float, float, float),
    metavar="X Y Z RADIUS",
    help="Where the robot drives, in the frame of station 1, in m.  [default: the scenario's]",
)
@click.option(
    "--envelope",
    type=(float, float, float, float, float, float),
    metavar="XMIN XMAX YMIN YMAX ZMIN ZMAX",
    help="Find the best layout in this box, in the frame of the robot, in m.",
)
@click.option(
    "--min-separation-mm",
    type=click.FloatRange(10, 10_000),
    callback=finite,
    default=300.0,
    show_default=True,
    help="Between two prisms in the envelope: instruments have to tell them apart.",
)
@click.option(
    "--objective",
    "criterion",
    type=click.Choice(["rotation", "position"]),
    default="rotation",
    show_default=True,
    help="What has to be known best.",
)
@click.option(
    "--point",
    "point_m",
    type=(float, float, float),
    metavar="X Y Z",
    default=(0.0, 0.0, 0.0),
    show_default=True,
    help="Point of the robot whose position counts, in its frame, in m: that of a sensor, say.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the starts of the search."
)
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
    """Rank prism LAYOUTS (set-up files) by how well they let the pose be known; find the best one in a box.

    The robot stands level at several places and headings, each station measures its prism once, and the noise of the
    instruments is propagated into the pose, to first order. The layout of the scenario or configuration is ranked
    with the others. Then the stations move: how does the pose of the first-ranked layout depend on their distance, and
    on whether they stand together or around the robot?
    """
    # No NaN is less than anything.
    if not all(
        abs(number_m) <= LARGEST_COORDINATE_M for number_m in (*(area or ()), *(envelope or ()), *point_m)
    ):
        raise click.UsageError(
            f"--area, --envelope and --point need finite numbers, at most {LARGEST_COORDINATE_M:g} m"
        )
    known, places, source = _setting(scenario_name, config_path, area)
    slots = {prism: slot for slot, prism in enumerate(sorted({s.prism for s in known.stations}))}
    stations = tuple(
        Station(np.array(s.T_station1_station)[:3, 3], s.noise, slots[s.prism]) for s in known.stations
    )
    stances, point = Stances.at(places), np.array(point_m)
    wanted = {source: _tracked({p.prism: p.position_m for p in known.prisms}, slots, source)}
    for path in layouts:
        wanted[str(path)] = _tracked(read_layout(path), slots, path)
    candidates = [
        _candidate(name, np.array(list(prisms.values())), stations, stances, point)
        for name, prisms in wanted.items()
    ]
    if envelope is not None:
        task = Task(
            envelope_m=_box(envelope),
            count=len(slots),
            min_separation_m=min_separation_mm / 1e3,
            criterion=criterion,
            stations=stations,
            stances=stances,
            point_m=point,
        )
        with progress("searching") as on_progress:
            found = best_layout(task, np.random.default_rng(seed), on_progress=on_progress)
        candidates.append(_candidate(_ENVELOPE, found, stations, stances, point))
    candidates.sort(key=lambda c: c.figures.rotation_rad if criterion == "rotation" else c.figures.position_m)
    centre = places.mean(axis=0)
    distances = {d: _by_arrangement(candidates[0], stations, centre, d, point) for d in _DISTANCES_M}
    if figure is not None:
        from tsgt.analysis.figures import draw_layouts

        draw_layouts({c.name: c.covariance for c in candidates}, distances, figure)
    if as_json:
        print_json(
            {
                "by": criterion,
                "point_m": point.tolist(),
                "stances": len(stances.position_m),
                "ranking": [candidate.name for candidate in candidates],
                "layouts": {
                    c.name: {
                        "prisms": dict(zip(slots, c.layout.tolist(), strict=True)),
                        **_keys(c.figures),
                    }
                    for c in candidates
                },
                "stations_at_m": {
                    f"{d:g}": {name: _keys(each) for name, each in found.items()}
                    for d, found in distances.items()
                },
            }
        )
        return
    _print(candidates, point, len(stances.position_m))
    if envelope is not None:
        _print_found(next(c for c in candidates if c.name == _ENVELOPE), slots)
    _print_distances(candidates[0].name, distances)


def _setting(
    scenario_name: str | None, config_path: Path | None, area: tuple[float, ...] | None
) -> tuple[Parameters, FloatArray, str]:
    """Who stands where, at which places the robot stands, (M, 3), and the name of what says so."""
    if config_path is not None:
        if scenario_name is not None:
            raise click.UsageError("--scenario and --config exclude each other")
        if area is None:
            raise click.UsageError("--config does not say where the robot drives; give --area")
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
    """Centre of the area and four places around it, on the circle that halves it."""
    x, y, z, radius = area
    if radius < 0:
        raise click.UsageError("--area: the radius is below zero")
    r = radius / math.sqrt(2)
    return np.array([[x, y, z], [x + r, y, z], [x, y + r, z], [x - r, y, z], [x, y - r, z]])


def _tracked(
    layout: Mapping[int, Vector3], slots: Mapping[int, int], source: Path | str
) -> Mapping[int, Vector3]:
    """Take those prisms of a layout that the stations track."""
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


def _candidate(
    name: str, layout: FloatArray, stations: tuple[Station, ...], stances: Stances, point: FloatArray
) -> _Candidate:
    return _Candidate(name, layout, pose_covariances(layout, stations, stances, point))


def _by_arrangement(
    candidate: _Candidate,
    stations: tuple[Station, ...],
    centre: FloatArray,
    distance_m: float,
    point: FloatArray,
) -> dict[str, LayoutFigures]:
    stances = Stances.at(centre[None])
    return {
        name: LayoutFigures.of(pose_covariances(candidate.layout, moved, stances, point))
        for name, moved in together_or_around(stations, centre, distance_m).items()
    }


def _keys(figures: LayoutFigures) -> dict[str, Any]:
    return {
        "position_sigma_mm": 1e3 * figures.position_m,
        "position_axes_sigma_mm": (1e3 * figures.position_axes_m).tolist(),
        "worst_position_sigma_mm": 1e3 * figures.worst_position_m,
        "rotation_sigma_mrad": 1e3 * figures.rotation_rad,
        "rotation_axes_sigma_mrad": (1e3 * figures.rotation_axes_rad).tolist(),
        "worst_rotation_sigma_mrad": 1e3 * figures.worst_rotation_rad,
    }


def _print(candidates: Sequence[_Candidate], point: FloatArray, stances: int) -> None:
    x, y, z = point
    click.echo(
        f"One measurement of each prism, the robot standing: root mean square over {stances} places and headings\n"
        f"of one sigma, of the position of ({x:g}, {y:g}, {z:g}) m and of the rotation (mm, mrad)\n"
    )
    rows = [
        [
            candidate.name,
            *_numbers(f.position_m, *f.position_axes_m, f.worst_position_m),
            *_numbers(f.rotation_rad, *f.rotation_axes_rad, f.worst_rotation_rad),
        ]
        for candidate in candidates
        for f in [candidate.figures]
    ]
    print_table(["layout", "position", *"xyz", "worst", "rotation", "roll", "pitch", "yaw", "worst"], rows)


def _print_found(found: _Candidate, slots: Mapping[int, int]) -> None:
    click.echo("\nThe best in the envelope, as it stands in a prism layout\n")
    for prism, slot in slots.items():
        x, y, z = found.layout[slot]
        click.echo(f"  [prisms.{prism}]\n  position_m = [{x:.3f}, {y:.3f}, {z:.3f}]")


def _print_distances(name: str, distances: Mapping[float, Mapping[str, LayoutFigures]]) -> None:
    click.echo(f"\nIf the stations stood elsewhere, with {name} (mm, mrad)\n")
    rows = []
    for distance_m, found in distances.items():
        figures = [value for f in found.values() for value in (f.position_m, f.rotation_rad)]
        rows.append([f"{distance_m:g} m", *_numbers(*figures)])
    header = [f"{what}, {how}" for how in next(iter(distances.values())) for what in ("position", "rotation")]
    print_table(["distance", *header], rows)


def _numbers(*values: float) -> list[str]:
    """Thousandths: mm of m, mrad of rad."""
    return [f"{1e3 * value:.2f}" for value in values]
