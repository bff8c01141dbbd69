"""How causes of errors of a set-up are worded, repaired and decided between. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass

from tsgt.geometry.motion_calibration import SetupCause

CALIBRATE_MOTION = "`tsgt calibrate motion RECORDING --output frames.toml`, then `--frames frames.toml` to process and evaluate"

BETWEEN_DRIVES = "Check the targets between drives (`tsgt calibrate check`), and solve the frames again when a tripod has moved."


@dataclass(frozen=True, slots=True)
class Wording:
    """How a kind of cause is described; ``unit`` has ``per_unit`` of the estimate's SI unit."""

    phrase: str  # with {n}, {size}
    short: str
    unit: str
    per_unit: float
    repair: str
    decides: str


WORDING: dict[SetupCause, Wording] = {
    SetupCause.TURNED: Wording(
        "Station {n} is turned by {size} about the vertical against its calibration",
        "station {n} turned",
        "mrad",
        1e3,
        f"Refine its frame: {CALIBRATE_MOTION}. Check the tripod: `tsgt calibrate check`.",
        "measure a target of the calibration again with that station (`tsgt calibrate check`), in both faces",
    ),
    SetupCause.TILTED: Wording(
        "Station {n} is tilted by {size} against its calibration",
        "station {n} tilted",
        "mrad",
        1e3,
        f"Level the instrument. Refine its frame: {CALIBRATE_MOTION}.",
        "measure targets on the far side of the stations, in both faces, or drive there",
    ),
    SetupCause.SHIFTED: Wording(
        "Station {n} is shifted by {size} against its calibration",
        "station {n} shifted",
        "mm",
        1e3,
        f"Refine its frame: {CALIBRATE_MOTION}. Check the tripod: `tsgt calibrate check`.",
        "measure a target near that station again (`tsgt calibrate check`)",
    ),
    SetupCause.FRAME: Wording(
        "The frame of station {n} is wrong by {size} at the robot",
        "frame of station {n}",
        "mm",
        1e3,
        f"Refine it: {CALIBRATE_MOTION}. Check its targets: `tsgt calibrate targets`.",
        "measure three targets of the calibration again (`tsgt calibrate check`)",
    ),
    SetupCause.SINKING: Wording(
        "Station {n} rises or sinks: its height changes by {size} during the recording",
        "station {n} sinking",
        "mm",
        1e3,
        f"Set the tripod up on firm ground. {BETWEEN_DRIVES}",
        "measure a target before and after the drive (`tsgt calibrate check`)",
    ),
    SetupCause.TURNING: Wording(
        "Station {n} turns: its direction changes by {size} during the recording",
        "station {n} turning",
        "mrad",
        1e3,
        f"Clamp the tripod and shade it from the sun. {BETWEEN_DRIVES}",
        "measure a target before and after the drive (`tsgt calibrate check`)",
    ),
    SetupCause.DRIFT: Wording(
        "Station {n} moves: its frame changes by {size} at the robot during the recording",
        "station {n} drifting",
        "mm",
        1e3,
        f"Set the tripod up on firm ground. {BETWEEN_DRIVES}",
        "measure three targets before and after the drive (`tsgt calibrate check`)",
    ),
    SetupCause.LATENCY: Wording(
        "The timestamps of station {n} are late by {size} against those of the others",
        "latency of station {n}",
        "ms",
        1e3,
        f"Calibrate the latencies: {CALIBRATE_MOTION}.",
        "drive the same path in both directions",
    ),
    SetupCause.VERTICAL_INDEX: Wording(
        "Station {n} has a vertical index error of {size} that its calibration does not contain",
        "vertical index of station {n}",
        "mrad",
        1e3,
        "Add this to `vertical_index_mrad` of that station in the file of station frames (0 if it has none), or measure the targets in both "
        "faces (`tsgt calibrate collect --repeats 2`), from which the frames are solved with it. Adjust the instrument before the next drive.",
        "measure one target in both faces with that station",
    ),
    SetupCause.COLLIMATION: Wording(
        "Station {n} has a collimation error of {size} that its calibration does not contain",
        "collimation of station {n}",
        "mrad",
        1e3,
        "Add this to `collimation_mrad` of that station in the file of station frames (0 if it has none). Adjust the instrument.",
        "measure one target in both faces with that station",
    ),
    SetupCause.RANGE_CONSTANT: Wording(
        "The distances of station {n} are too short by {size}",
        "range constant of station {n}",
        "mm",
        1e3,
        "Check the prism constant of that station, in the instrument and in the configuration (`prism_constant_mm`).",
        "measure a known distance of some metres with that station and its prism",
    ),
    SetupCause.RANGE_SCALE: Wording(
        "The distances of station {n} are too short by {size}",
        "range scale of station {n}",
        "ppm",
        1e6,
        "Check temperature and pressure of that instrument (`tsgt atmosphere`).",
        "measure a target at some hundred metres with all stations",
    ),
    SetupCause.PRISM: Wording(
        "Prism {n} is {size} from its place in the prism layout",
        "prism {n}",
        "mm",
        1e3,
        "Measure the prisms again (`tsgt calibrate prisms`), or estimate them from the motion: "
        "`tsgt calibrate motion RECORDING --estimate-prisms --prism-output prisms.toml`, then `--prisms prisms.toml`.",
        "measure the distances between the prisms with one station (`tsgt calibrate prisms`)",
    ),
}
