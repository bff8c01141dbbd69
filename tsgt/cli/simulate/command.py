"""The command ``simulate``: a mission in virtual time."""

from __future__ import annotations

import dataclasses
import math
import shlex
import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np
from click.core import ParameterSource

from tsgt.analysis.formats import tum_lines
from tsgt.cli.model_options import add_options, model_option
from tsgt.cli.options import RECORDING_SUFFIXES, OutputFile, json_option, point_option, resolved_point
from tsgt.cli.output import CHECK_FAILED, numbers, print_json, print_table, require_new_file
from tsgt.cli.progress import progress
from tsgt.cli.simulate.figures import figures
from tsgt.config import (
    MAX_STATION_NUMBERS,
    ClassicMasterConfig,
    PipelineConfig,
    ReferencePointConfig,
    ScenarioConfig,
    ScenarioRadioConfig,
    SimulatedImu,
    SuperframeMasterConfig,
    scenario_parameters,
)
from tsgt.errors import OutputFileError, TsgtError
from tsgt.estimation import point_label, reference_point_text
from tsgt.geometry import quaternion_from_rotation
from tsgt.log import configure_logging
from tsgt.model import MIN_PRISMS, ReferencePoint
from tsgt.recording import write_atomically
from tsgt.simulation.checks import Violation, check_invariants
from tsgt.simulation.faults import (
    FAST_SYNC_CYCLES,
    FAULT_FREE_START_S,
    FAULT_FREE_TAIL_S,
    IMU_FAULTS,
    ODOMETRY_FAULTS,
    FaultKind,
    parse_faults,
)
from tsgt.simulation.options import Outage, Restart, SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import MAX_STATIONS, find_scenario, with_stations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.config import ImuModelName
    from tsgt.simulation.mission import MissionResult

LISTED_VIOLATIONS = 20

protocol_option = click.option(
    "--protocol",
    type=click.Choice(["superframe", "classic"]),
    default="superframe",
    help=SimulationOptions.model_fields["protocol"].description,
)


@click.command("simulate")
@click.argument("scenario_name", metavar="[SCENARIO]", default="dynamic")
@protocol_option
@add_options(
    model_option(
        ScenarioConfig,
        "duration_s",
        "--duration",
        default=None,
        help="Duration of the measurements in s.  [default: that of the scenario]",
    ),
    click.option(
        "--stations",
        type=click.IntRange(1, MAX_STATIONS),
        help="Number of stations; additional ones track the prisms in turn.  [default: that of the scenario]",
    ),
    model_option(
        SimulatedImu,
        "model",
        "--imu",
        default=None,
        help="Class of the robot's IMU; with one, the robot is shaken while it drives.  [default: that of the scenario]",
    ),
    click.option(
        "--odometry", is_flag=True, help="The robot has wheel odometry, too, which is used with its IMU."
    ),
    model_option(
        ScenarioRadioConfig,
        "loss_probability",
        "--loss",
        default=None,
        help="Probability that a packet is lost.  [default: that of the scenario]",
    ),
    model_option(SimulationOptions, "drift_ppm"),
    model_option(SimulationOptions, "drift_ramp_ppm_per_min"),
    model_option(SimulationOptions, "stamp_jitter_us"),
    model_option(
        ClassicMasterConfig,
        "clock_filter",
        default=None,
        help="Clock filter of the master; protocol classic only.  [default: regression]",
    ),
    model_option(SimulationOptions, "station_software"),
    click.option(
        "--unauthenticated", is_flag=True, help="Run the radios without a key; protocol superframe only."
    ),
    click.option(
        "--outage",
        "outage_texts",
        metavar="STATIONS:START:SECONDS",
        multiple=True,
        help="Interrupt the radio contact of stations: all, or numbers separated by commas; may be repeated.",
    ),
    click.option(
        "--restart",
        "restart_texts",
        metavar="STATION:AT",
        multiple=True,
        help="End a client, or the master, at this time and start it 2 s later; may be repeated.",
    ),
    model_option(SimulationOptions, "interference_rate_hz"),
    click.option(
        "--faults",
        "faults_text",
        metavar="NAMES",
        default="none",
        help=f"Inject faults drawn from the seed: all, or names separated by commas: {', '.join(FaultKind)}.",
    ),
    model_option(
        PipelineConfig,
        "estimator",
        default=None,
        help="Estimator of the master.  [default: that of the scenario]",
    ),
    model_option(SimulationOptions, "seed"),
    point_option("that of the scenario, else the robot's origin"),
    click.option(
        "--output", type=OutputFile(*RECORDING_SUFFIXES), help="Write the master's recording (.jsonl)."
    ),
    click.option("--truth", type=OutputFile(".tum"), help="Write the true poses (.tum)."),
)
@json_option
def simulate_command(
    *,
    scenario_name: str,
    protocol: str,
    duration_s: float | None,
    stations: int | None,
    model: ImuModelName | None,
    odometry: bool,
    loss_probability: float | None,
    clock_filter: Literal["regression", "paper"] | None,
    unauthenticated: bool,
    outage_texts: tuple[str, ...],
    restart_texts: tuple[str, ...],
    faults_text: str,
    estimator: str | None,
    point: ReferencePoint | str | None,
    output: Path | None,
    truth: Path | None,
    as_json: bool,
    **given: Any,
) -> int:
    """Simulate a mission in virtual time.

    Robot, radio channel, instruments and clocks are simulated, the daemons are the real ones; the same seed gives the
    same mission. SCENARIO is dynamic, static, quarry, ski-trail, snowmobile, or the path of a file. Invariants are
    checked during the mission.

    Exit code 3: an invariant was violated.
    """
    for path in (output, truth):
        require_new_file(path)
    _check_protocol(protocol, clock_filter, given["station_software"], unauthenticated=unauthenticated)
    scenario = _edited(
        find_scenario(scenario_name),
        stations=stations,
        model=model,
        odometry=odometry,
        estimator=estimator,
        point=point,
        loss_probability=loss_probability,
    )
    station_numbers = tuple(station.station for station in scenario.stations)
    _check_station_numbers(station_numbers, protocol)
    faults = _parsed_faults(faults_text, scenario)
    options = SimulationOptions(
        duration_s=scenario.duration_s if duration_s is None else duration_s,
        protocol=_protocol(protocol, clock_filter, fast_sync=bool(faults)),
        authenticated=not unauthenticated,
        outages=tuple(Outage.parse(text, station_numbers) for text in outage_texts),
        restarts=tuple(Restart.parse(text, station_numbers) for text in restart_texts),
        faults=faults,
        **given,
    )
    if scenario.imu.model == "none" and len({station.prism for station in scenario.stations}) < MIN_PRISMS:
        click.echo(
            f"note: poses need {MIN_PRISMS} tracked prisms, or an IMU: add --imu industrial or --imu consumer",
            err=True,
        )
    _check_times(options)
    configure_logging("critical" if faults else "error")  # the figures say what happened
    replay_command = _replay_command(click.get_current_context())
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="tsgt-simulate-") as folder:
        run = _simulate(scenario, options, Path(folder))
        found = check_invariants(run)
        result = {
            "scenario": scenario.name,
            "protocol": protocol,
            "station_software": options.station_software,
            "clock_filter": (clock_filter or "regression") if protocol == "classic" else None,
            "seed": options.seed,
            "replay_command": replay_command,
            "faults": {str(kind): count for kind, count in sorted(run.faults.items())},
            **figures(run),
            "violations": len(found),
            "violations_listed": [f"{v.check}: {v.detail}" for v in found[:LISTED_VIOLATIONS]],
        }
        if output is not None:
            _write_recording(run, output)
    if truth is not None:
        _write_truth(run, truth)
    result["wall_seconds"] = time.perf_counter() - started_s
    if as_json:
        print_json(result)
    else:
        _print(result, found)
    return CHECK_FAILED if found else 0


def _check_protocol(
    protocol: str,
    clock_filter: str | None,
    station_software: str,
    *,
    unauthenticated: bool,
) -> None:
    """Reject options of the other protocol."""
    if protocol != "classic" and station_software == "authors":
        raise click.UsageError("the authors' node speaks classic only; add --protocol classic")
    if protocol != "classic" and clock_filter is not None:
        raise click.UsageError("--clock-filter is for the protocol classic; add --protocol classic")
    if protocol == "classic" and unauthenticated:
        raise click.UsageError("--unauthenticated is for the protocol superframe; classic never has a key")


def _edited(
    scenario: ScenarioConfig,
    *,
    stations: int | None,
    model: ImuModelName | None,
    odometry: bool,
    estimator: str | None,
    point: ReferencePoint | str | None,
    loss_probability: float | None,
) -> ScenarioConfig:
    """Return a scenario with what the options change in it."""
    if stations is not None:
        scenario = with_stations(scenario, stations)
    if model is not None:
        scenario = scenario.model_copy(update={"imu": scenario.imu.model_copy(update={"model": model})})
    if odometry:
        if scenario.imu.model == "none":
            raise click.UsageError(
                "--odometry is used with an IMU, and the robot has none; add --imu industrial"
            )
        scenario = scenario.model_copy(update={"odometry": True})
    if estimator is not None:
        pipeline = scenario.pipeline.model_copy(update={"estimator": estimator})
        scenario = scenario.model_copy(update={"pipeline": pipeline})
    if point is not None:
        known = scenario_parameters(scenario, imu=True)
        config = ReferencePointConfig(**dataclasses.asdict(resolved_point(point, known)))
        scenario = scenario.model_copy(update={"reference_point": config})
    if loss_probability is not None:
        radio = scenario.radio.model_copy(update={"loss_probability": loss_probability})
        scenario = scenario.model_copy(update={"radio": radio})
    return scenario


def _check_station_numbers(station_numbers: Sequence[int], protocol: str) -> None:
    for number in station_numbers:
        if number > MAX_STATION_NUMBERS[protocol]:
            raise click.UsageError(
                f"station {number}: {protocol} has station numbers 1 to {MAX_STATION_NUMBERS[protocol]}"
            )


def _parsed_faults(text: str, scenario: ScenarioConfig) -> frozenset[FaultKind]:
    """Return the kinds of faults; rejects those that the scenario cannot have."""
    faults = parse_faults(text)
    if faults and faults <= IMU_FAULTS and scenario.imu.model == "none":
        raise click.UsageError(
            "--faults: these are faults of the IMU, and the robot has none; add --imu industrial"
        )
    if faults and faults <= ODOMETRY_FAULTS and not scenario.odometry:
        raise click.UsageError(
            "--faults: these are faults of the wheel odometry, and the robot has none; add --imu industrial --odometry"
        )
    return faults


def _protocol(
    name: str, clock_filter: Literal["regression", "paper"] | None, *, fast_sync: bool
) -> ClassicMasterConfig | SuperframeMasterConfig:
    if name == "superframe":
        return SuperframeMasterConfig(kind="superframe")
    config = ClassicMasterConfig(kind="classic", clock_filter=clock_filter or "regression")
    return config.model_copy(update={"initial_cycles": FAST_SYNC_CYCLES}) if fast_sync else config


def _replay_command(context: click.Context) -> str:
    """Return the command that gives the same mission, without its output files."""
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
                text = reference_point_text(each) if isinstance(each, ReferencePoint) else str(each)
                words += [parameter.opts[0], *([] if each is True else [shlex.quote(text)])]
    return " ".join(words)


def _check_times(options: SimulationOptions) -> None:
    """Reject what would happen after the end of the mission."""
    if options.faults and options.duration_s < FAULT_FREE_TAIL_S + 2 * FAULT_FREE_START_S:
        raise click.UsageError(
            f"--faults needs a --duration of at least {FAULT_FREE_TAIL_S + 2 * FAULT_FREE_START_S:g} s: the last {FAULT_FREE_TAIL_S:g} s are free of faults"
        )
    starts_s = [("--outage", outage.start_s) for outage in options.outages]
    starts_s += [("--restart", restart.at_s) for restart in options.restarts]
    for option, start_s in starts_s:
        if start_s >= options.duration_s:
            raise click.UsageError(
                f"{option} at {start_s:g} s: the mission ends at {options.duration_s:g} s; give an earlier time or a longer "
                "--duration"
            )


def _simulate(scenario: ScenarioConfig, options: SimulationOptions, folder: Path) -> MissionResult:
    with progress("simulating") as on_progress:

        def report(now_s: float) -> None:
            if on_progress is not None:
                on_progress(now_s / options.duration_s)

        try:
            return simulate(scenario, options, folder=folder, progress=report)
        except ExceptionGroup as group:
            known = group.subgroup(TsgtError)
            if known is None:
                raise
            error: BaseException = known
            while isinstance(error, ExceptionGroup):
                error = error.exceptions[0]
            raise error from group


def _write_recording(run: MissionResult, output: Path) -> None:
    path = run.master_logs[-1].recording()
    if path is None:
        raise OutputFileError(
            "the master wrote no recording: it ended before the first line; use a longer --duration, or see --faults",
            path=output,
        )
    with path.open("rb") as source, write_atomically(output) as target:
        shutil.copyfileobj(source, target)


def _write_truth(run: MissionResult, truth: Path) -> None:
    """Write the true poses of the reference point at the epochs of the stream, on the clock of the recording."""
    period_ns = run.parameters.pipeline.period_ns
    zero_ns = run.master_logs[-1].unix_at_zero_ns
    end_ns = zero_ns + run.end_ns - run.start_ns
    stamps_ns = np.arange(-(-zero_ns // period_ns) * period_ns, end_ns + 1, period_ns, dtype=np.int64)
    poses = run.true_poses((stamps_ns - zero_ns) / 1e9)
    columns = (stamps_ns, poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]))
    with write_atomically(truth) as file:
        rows = zip(*(column.tolist() for column in columns), strict=True)
        file.writelines(line.encode() for line in tum_lines(rows, run.parameters.reference_point))


def _print(result: dict[str, Any], found: list[Violation]) -> None:
    click.echo(
        f"{result['scenario']}, {result['protocol']} ({result['station_software']}), seed {result['seed']}: "
        f"{result['sim_seconds']:g} s simulated in {result['wall_seconds']:.1f} s\n"
    )
    rows = [
        [
            str(number),
            *(str(station[key]) for key in ("measured", "delivered", "duplicates")),
            *numbers(station["rate_hz"]),
            *numbers(*(station["age_ms"][key] for key in ("p50", "p99")), digits=0),
            f"{station['within_2s']:.2%}",
            *numbers(*(station["time_error_us"][key] for key in ("p50", "p99", "max")), digits=0),
            *("-" if station[key] is None else str(station[key]) for key in ("queued", "missed_slots")),
        ]
        for number, station in result["stations"].items()
    ]
    header = [
        *("station", "measured", "delivered", "duplicates", "rate Hz", "age ms: p50", "p99", "in 2 s"),
        *("time error us: p50", "p99", "max", "queued", "missed slots"),
    ]
    print_table(header, rows)
    if "frame_ms" in result:
        click.echo(f"\nframe        {_number(result['frame_ms'], 0)} ms (mean)")
    for outage in result["outages"]:
        click.echo(
            f"\noutage       of {', '.join(map(str, outage['stations']))}, {outage['seconds']:g} s from "
            f"{outage['start_s']:g} s: backlog drained after {_number(outage['drained_s'], 1)} s; median age of live "
            f"measurements meanwhile {_number(outage['live_age_ms']['p50'], 0)} ms"
        )
    point = ReferencePoint(**result["reference_point"])
    click.echo(f"\nPose errors, positions at {point_label(point)} and at the prisms' centroid")
    rows = [
        [
            name,
            str(found["poses"]),
            str(found["valid_poses"]),
            *numbers(found["position_rms_mm"], found["centroid"]["position_rms_mm"], digits=1),
            *numbers(found["orientation_rms_deg"]),
            *numbers(found["nees"]["mean"], digits=1),
            *(_number(found["age_ms"][key], 0) if "age_ms" in found else "-" for key in ("p50", "p99")),
        ]
        for name, found in {
            **result["estimators"],
            **{f"live, {kind}": found for kind, found in result["live"].items()},
        }.items()
    ]
    header = [
        *("", "poses", "valid", f"{point.name} rms mm", "centroid rms mm", "rms deg", "NEES (6)"),
        *("age ms: p50", "p99"),
    ]
    print_table(header, rows)
    inter_prism_mm = next(iter(result["estimators"].values()))["inter_prism_mean_mm"]
    click.echo(f"\ninter-prism  {_number(inter_prism_mm, 1)} mm mean error of the distances")
    click.echo(f"\nairtime      {result['airtime_fraction']:.1%} of the time")
    if result["faults"]:
        click.echo("faults       " + ", ".join(f"{count} {kind}" for kind, count in result["faults"].items()))
    click.echo(f"violations   {len(found)}")
    if found:
        click.echo(f"  reproduce with: {result['replay_command']}")
    for line in result["violations_listed"]:
        click.echo(f"  {line}")
    if len(found) > LISTED_VIOLATIONS:
        click.echo(f"  ... and {len(found) - LISTED_VIOLATIONS} more")


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
