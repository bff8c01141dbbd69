"""The command ``simulate``: the whole system in virtual time."""

from __future__ import annotations

import math
import shlex
import shutil
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np
from click.core import ParameterSource

from tsgt.analysis.formats import tum_lines
from tsgt.cli.options import finite, json_option
from tsgt.cli.output import CHECK_FAILED, print_json, print_table, require_new_file
from tsgt.cli.simulate.figures import figures
from tsgt.config import LARGEST_NUMBERS, ClassicMasterConfig, SuperframeMasterConfig
from tsgt.errors import OutputFileError, TsgtError
from tsgt.geometry import quaternion_from_rotation
from tsgt.log import configure_logging
from tsgt.recording import write_atomically
from tsgt.simulation.checks import Violation, violations
from tsgt.simulation.faults import FAULT_FREE_TAIL_S, FAST_SYNC_CYCLES, FAULT_FREE_START_S, FaultKind, parse_faults
from tsgt.simulation.options import SimulationOptions, Outage, Restart
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import MAX_STATIONS, find_scenario, with_stations

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tsgt.config import ScenarioConfig
    from tsgt.simulation.mission import MissionResult

LISTED_VIOLATIONS = 20


@click.command("simulate")
@click.argument("scenario_name", metavar="[SCENARIO]", default="dynamic")
@click.option(
    "--protocol",
    type=click.Choice(["superframe", "classic"]),
    default="superframe",
    show_default=True,
    help="What master and stations speak.",
)
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=0, max=86_400, min_open=True),
    callback=finite,
    help="How many seconds it measures.  [default: what the scenario says]",
)
@click.option(
    "--stations",
    type=click.IntRange(1, MAX_STATIONS),
    help="How many; more than there are prisms track them in turn.  [default: those of the scenario]",
)
@click.option(
    "--loss",
    type=click.FloatRange(0, 1),
    callback=finite,
    help="Probability that a packet is not heard.  [default: what the scenario says]",
)
@click.option(
    "--drift-ppm",
    type=click.FloatRange(-1000, 1000),
    callback=finite,
    default=10.0,
    show_default=True,
    help="Drift of the stations' clocks against the master's: plus for the first, minus for the second, and so on.",
)
@click.option(
    "--drift-ramp-ppm-per-min",
    type=click.FloatRange(-50, 50),
    callback=finite,
    default=0.0,
    show_default=True,
    help="By how much that drift grows, as the computers get warm; after ten minutes it falls again.",
)
@click.option(
    "--stamp-jitter-us",
    type=click.FloatRange(0, 10_000),
    callback=finite,
    default=0.0,
    show_default=True,
    help="Scatter of each computer's stamps of its radio, one sigma.",
)
@click.option(
    "--clock-filter",
    type=click.Choice(["regression", "paper"]),
    help="How the master follows the stations' clocks; of the protocol classic.  [default: regression]",
)
@click.option(
    "--station-software",
    type=click.Choice(["ours", "authors"]),
    default="ours",
    show_default=True,
    help="What the stations run: our client, or a node as the paper's authors deployed it, which speaks classic.",
)
@click.option("--unauthenticated", is_flag=True, help="Radios without a key; of the protocol superframe.")
@click.option(
    "--outage",
    "outage_texts",
    metavar="STATIONS:START:SECONDS",
    multiple=True,
    help="The master and these stations do not hear each other for a time; all, or numbers with commas.",
)
@click.option(
    "--restart",
    "restart_texts",
    metavar="STATION:AT",
    multiple=True,
    help="A client, or the master, ends at this time and is started again 2 s later.",
)
@click.option(
    "--interference-rate-hz",
    type=click.FloatRange(0, 100),
    callback=finite,
    default=0.0,
    show_default=True,
    help="Packets per second of somebody else: noise, and what it has heard, as it was, cut or changed.",
)
@click.option(
    "--faults",
    "faults_text",
    metavar="NAMES",
    default="none",
    show_default=True,
    help=f"Let things go wrong, drawn from the seed: all, or names with commas of {', '.join(FaultKind)}.",
)
@click.option(
    "--estimator",
    type=click.Choice(["linear", "continuous"]),
    help="How the master makes its poses.  [default: what the scenario says]",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another run."
)
@click.option("--output", type=click.Path(path_type=Path), help="Keep the master's recording here.")
@click.option("--truth", type=click.Path(path_type=Path), help="Write the true poses here, as TUM.")
@json_option
def simulate_command(
    *,
    scenario_name: str,
    protocol: str,
    duration_s: float | None,
    stations: int | None,
    loss: float | None,
    drift_ppm: float,
    drift_ramp_ppm_per_min: float,
    stamp_jitter_us: float,
    clock_filter: Any,
    station_software: Any,
    unauthenticated: bool,
    outage_texts: tuple[str, ...],
    restart_texts: tuple[str, ...],
    interference_rate_hz: float,
    faults_text: str,
    estimator: Any,
    seed: int,
    output: Path | None,
    truth: Path | None,
    as_json: bool,
) -> int:
    """Run master and stations in virtual time, on a simulated robot, radio channel, instruments and clocks.

    SCENARIO is dynamic, static, quarry, ski-trail, snowmobile, or the path of a file. The daemons are the real
    ones, and one seed gives one run. Everything is checked on the way; what must not happen and does is listed,
    with exit code 3.
    """
    for path in (output, truth):
        require_new_file(path)
    if protocol != "classic" and station_software == "authors":
        raise click.UsageError("the authors' node speaks classic alone; say --protocol classic")
    if protocol != "classic" and clock_filter is not None:
        raise click.UsageError(
            "--clock-filter is of classic, where the master follows clocks; say --protocol classic"
        )
    if protocol == "classic" and unauthenticated:
        raise click.UsageError("--unauthenticated is of superframe; classic never has a key")
    scenario = find_scenario(scenario_name)
    if stations is not None:
        scenario = with_stations(scenario, stations)
    if estimator is not None:
        pipeline = scenario.pipeline.model_copy(update={"estimator": estimator})
        scenario = scenario.model_copy(update={"pipeline": pipeline})
    numbers = tuple(station.station for station in scenario.stations)
    for number in numbers:
        if number > LARGEST_NUMBERS[protocol]:
            raise click.UsageError(f"station {number}: {protocol} knows 1 to {LARGEST_NUMBERS[protocol]}")
    if loss is not None:
        radio = scenario.radio.model_copy(update={"loss_probability": loss})
        scenario = scenario.model_copy(update={"radio": radio})
    faults = parse_faults(faults_text)
    options = SimulationOptions(
        duration_s=scenario.duration_s if duration_s is None else duration_s,
        drift_ppm=drift_ppm,
        drift_ramp_ppm_per_min=drift_ramp_ppm_per_min,
        stamp_jitter_us=stamp_jitter_us,
        seed=seed,
        station_software=station_software,
        protocol=SuperframeMasterConfig(kind="superframe")
        if protocol == "superframe"
        else _classic(clock_filter, often_anew=bool(faults)),
        authenticated=not unauthenticated,
        outages=tuple(Outage.parse(text, numbers) for text in outage_texts),
        restarts=tuple(Restart.parse(text, numbers) for text in restart_texts),
        interference_rate_hz=interference_rate_hz,
        faults=faults,
    )
    _check_times(options)
    configure_logging("critical" if faults else "error")  # what happens on the way stands in the figures
    again = _again(click.get_current_context())
    began_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="tsgt-simulate-") as folder:
        run = _simulate(scenario, options, Path(folder))
        found = violations(run)
        result = {
            "scenario": scenario.name,
            "protocol": protocol,
            "station_software": station_software,
            "clock_filter": (clock_filter or "regression") if protocol == "classic" else None,
            "seed": seed,
            "replay_command": again,
            "faults": {str(kind): count for kind, count in sorted(run.faults.items())},
            **figures(run),
            "violations": len(found),
            "violations_listed": [f"{v.check}: {v.detail}" for v in found[:LISTED_VIOLATIONS]],
        }
        if output is not None:
            _keep_recording(run, output)
    if truth is not None:
        _write_truth(run, truth)
    result["wall_seconds"] = time.perf_counter() - began_s
    if as_json:
        print_json(result)
    else:
        _print(result, found)
    return CHECK_FAILED if found else 0


def _classic(clock_filter: Literal["regression", "paper"] | None, *, often_anew: bool) -> ClassicMasterConfig:
    """Return the protocol's settings."""
    config = ClassicMasterConfig(kind="classic", clock_filter=clock_filter or "regression")
    return config.model_copy(update={"initial_cycles": FAST_SYNC_CYCLES}) if often_anew else config


def _again(context: click.Context) -> str:
    """Write the command that gives the same run again, without what it writes."""
    words = ["tsgt simulate"]
    for parameter in context.command.params:
        name, value = parameter.name or "", context.params.get(parameter.name or "")
        if name in {"output", "truth", "as_json"}:
            continue
        if name != "seed" and context.get_parameter_source(name) is not ParameterSource.COMMANDLINE:
            continue
        for each in value if isinstance(value, tuple) else (value,):
            if isinstance(parameter, click.Argument):
                words.append(shlex.quote(str(each)))
            else:
                words += [parameter.opts[0], *([] if each is True else [shlex.quote(str(each))])]
    return " ".join(words)


def _check_times(options: SimulationOptions) -> None:
    """Refuse what would happen after the end of the run: it would look as if nothing came of it."""
    if options.faults and options.duration_s < FAULT_FREE_TAIL_S + 2 * FAULT_FREE_START_S:
        raise click.UsageError(
            f"--faults needs a --duration of at least {FAULT_FREE_TAIL_S + 2 * FAULT_FREE_START_S:g} s: the last {FAULT_FREE_TAIL_S:g} s are without any"
        )
    starts_s = [("--outage", outage.start_s) for outage in options.outages]
    starts_s += [("--restart", restart.at_s) for restart in options.restarts]
    for option, start_s in starts_s:
        if start_s >= options.duration_s:
            raise click.UsageError(
                f"{option} at {start_s:g} s: the run ends at {options.duration_s:g} s; give an earlier one, or a longer "
                "--duration"
            )


def _simulate(scenario: ScenarioConfig, options: SimulationOptions, folder: Path) -> MissionResult:
    with _progress(options.duration_s) as progress:
        try:
            return simulate(scenario, options, folder=folder, progress=progress)
        except ExceptionGroup as group:
            known = group.subgroup(TsgtError)
            if known is None:
                raise
            error: BaseException = known
            while isinstance(error, ExceptionGroup):
                error = error.exceptions[0]
            raise error from group


@contextmanager
def _progress(duration_s: float) -> Iterator[Callable[[float], None]]:
    """Show on a terminal how many seconds have been simulated."""
    if not sys.stderr.isatty():
        yield lambda now_s: None  # noqa: ARG005 (nobody looks)
        return
    with click.progressbar(length=max(1, round(duration_s)), label="simulating", file=sys.stderr) as bar:
        yield lambda now_s: bar.update(round(now_s) - bar.pos)


def _keep_recording(run: MissionResult, output: Path) -> None:
    path = run.master_logs[-1].recording()
    if path is None:
        raise OutputFileError("the master made no recording that could be kept", path=output)
    with path.open("rb") as source, write_atomically(output) as target:
        shutil.copyfileobj(source, target)


def _write_truth(run: MissionResult, truth: Path) -> None:
    """Write the true poses at the epochs of the stream, from the start to the end of the run."""
    period_ns = run.parameters.pipeline.period_ns
    zero_ns = run.master_logs[-1].unix_at_zero_ns  # on the clock of the recording that is kept
    end_ns = zero_ns + run.end_ns - run.start_ns
    stamps_ns = np.arange(-(-zero_ns // period_ns) * period_ns, end_ns + 1, period_ns, dtype=np.int64)
    poses = run.world.pose_at((stamps_ns - zero_ns) / 1e9)
    columns = (stamps_ns, poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]))
    with write_atomically(truth) as file:
        file.writelines(line.encode() for line in tum_lines(zip(*(c.tolist() for c in columns), strict=True)))


def _print(result: dict[str, Any], found: list[Violation]) -> None:
    click.echo(
        f"{result['scenario']}, {result['protocol']} ({result['station_software']}), seed {result['seed']}: "
        f"{result['sim_seconds']:g} s simulated in {result['wall_seconds']:.1f} s\n"
    )
    rows = [
        [
            str(number),
            *(str(station[key]) for key in ("measured", "delivered", "duplicates")),
            _figure(station["rate_hz"], 2),
            *(_figure(station["age_ms"][key], 0) for key in ("p50", "p99")),
            f"{station['within_2s']:.2%}",
            *(_figure(station["time_error_us"][key], 0) for key in ("p50", "p99", "max")),
            *("-" if station[key] is None else str(station[key]) for key in ("queued", "late_slots")),
        ]
        for number, station in result["stations"].items()
    ]
    header = [
        *("station", "measured", "delivered", "twice", "rate Hz", "age ms: p50", "p99", "in 2 s"),
        *("time error us: p50", "p99", "max", "queued", "late"),
    ]
    print_table(header, rows)
    if "frame_ms" in result:
        click.echo(f"\nframe        {_figure(result['frame_ms'], 0)} ms in the mean")
    for outage in result["outages"]:
        click.echo(
            f"\noutage       of {', '.join(map(str, outage['stations']))}, {outage['seconds']:g} s from "
            f"{outage['start_s']:g} s on: drained after {_figure(outage['drained_s'], 1)} s, meanwhile live "
            f"measurements were {_figure(outage['live_age_ms']['p50'], 0)} ms old in the median"
        )
    click.echo("\nPoses against the truth, positions at the centroid of the prisms")
    rows = [
        [
            name,
            str(found["poses"]),
            str(found["valid_poses"]),
            _figure(found["position_rms_mm"], 1),
            _figure(found["orientation_rms_deg"], 2),
            _figure(found["nees"]["mean"], 1),
            *(_figure(found["newest_ms"][key], 0) if "newest_ms" in found else "-" for key in ("p50", "p99")),
        ]
        for name, found in {
            **result["estimators"],
            **{f"live, {kind}": found for kind, found in result["live"].items()},
        }.items()
    ]
    print_table(
        ["", "poses", "valid", "rms mm", "rms deg", "NEES (6)", "newest data, age ms: p50", "p99"], rows
    )
    inter_prism_mm = next(iter(result["estimators"].values()))["inter_prism_mean_mm"]
    click.echo(f"\ninter-prism  {_figure(inter_prism_mm, 1)} mm mean error of the distances")
    click.echo(f"\nairtime      {result['airtime_fraction']:.1%} of the time")
    if result["faults"]:
        click.echo("faults       " + ", ".join(f"{count} {kind}" for kind, count in result["faults"].items()))
    click.echo(f"violations   {len(found)}")
    if found:
        click.echo(f"  again with: {result['replay_command']}")
    for line in result["violations_listed"]:
        click.echo(f"  {line}")
    if len(found) > LISTED_VIOLATIONS:
        click.echo(f"  ... and {len(found) - LISTED_VIOLATIONS} more")


def _figure(value: float, digits: int) -> str:
    """Write a figure, a dash where there was nothing to compute it from."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
