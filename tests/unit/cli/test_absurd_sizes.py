"""Absurd numbers in files and options: one line of error on input, no overflow later."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks
from harness.files.cli import called
from harness.files.cli_contract import Files, check_command

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs"
DYNAMIC = (CONFIGS / "scenarios" / "dynamic.toml").read_text()
TRAIL = (CONFIGS / "scenarios" / "ski-trail.toml").read_text()
MASTER = (CONFIGS / "master.example.toml").read_text()
SETUP = {
    "prism_layout.example.toml": (CONFIGS / "prism_layout.example.toml").read_text(),
    "station_frames.example.toml": (CONFIGS / "station_frames.example.toml").read_text(),
    "radio.key": hashlib.sha256(b"a key").hexdigest() + "\n",
}
PRISM_LINES = """point,kind,horizontal_angle_deg,zenith_angle_deg,slope_distance_m,constant_mm,x_m,y_m,z_m
1,prism,10.0,80.0,20.0,10,,,
A,body,11.0,81.0,20.1,10,1.0,0.0,0.5
"""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return valid files by name: set-up files, recordings of angles and of points, and their sources."""
    folder = tmp_path_factory.mktemp("good")
    tracks = write_tracks(folder, duration_s=6.0)
    prisms, targets = write_prisms(folder), write_targets(folder)
    imported = ("import", "rts", "--tracks", *tracks, "--prisms", prisms)
    assert called(*imported, "--targets", targets, *CONSTANTS, "--output", folder / "r.jsonl").code == 0
    assert called(*imported, "--output", folder / "p.jsonl").code == 0
    assert called("process", folder / "r.jsonl", "--output", folder / "r.tum").code == 0
    return {path.name: path.read_text() for path in folder.iterdir()} | SETUP | {"prisms.csv": PRISM_LINES}


def refused(good: dict[str, str], arguments: tuple[str, ...], name: str, content: str, words: str) -> None:
    """Check that a command reports a file with these words in one line."""
    output = {"process": "o.tum", "import": "o.jsonl", "calibrate": "o.toml"}.get(arguments[0], "o")
    with Files({key: text.encode() for key, text in {**good, name: content}.items()}) as files:
        outcome = check_command(files, arguments, output=output)
    assert outcome.code in (1, 2), outcome
    assert words in outcome.err


def with_number(text: str, key: str, number: str) -> str:
    """Replace the first number after a key."""
    changed, count = re.subn(rf"(\b{key}\W*?)-?\d[\d.e-]*", rf"\g<1>{number}", text, count=1)
    assert count == 1
    return changed


@pytest.mark.parametrize("number", ["1e300", "-1e300", "1e9"])
@pytest.mark.parametrize(
    ("name", "key", "option"),
    [
        ("prism_layout.example.toml", "position_m", "--prisms"),
        ("station_frames.example.toml", "0.0, 0.0, 1.0,", "--frames"),
    ],
)
def test_absurd_coordinate_in_a_set_up_file(
    good: dict[str, str], name: str, key: str, option: str, number: str
) -> None:
    """The error names file and key."""
    content = with_number(good[name], re.escape(key) if option == "--frames" else key, number)
    refused(good, ("process", "@r.jsonl", option, f"@{name}"), name, content, f"{name}: ")
    with Files(
        {key: text.encode() for key, text in {**good, name: content, "c.toml": MASTER}.items()}
    ) as files:
        assert check_command(files, ("config", "check", "@c.toml")).code == 2


@pytest.mark.parametrize("number", [1e300, -1e300, 1e9])
@pytest.mark.parametrize("recording", ["r.jsonl", "p.jsonl"])
@pytest.mark.parametrize("what", ["prism", "frame", "rotation"])
def test_absurd_coordinate_in_a_recording(
    good: dict[str, str], recording: str, what: str, number: float
) -> None:
    """The error names the line."""
    head, parameters, *others = good[recording].splitlines(keepends=True)
    changed = json.loads(parameters)
    if what == "prism":
        changed["prisms"][1]["position_m"][2] = number
    else:
        changed["stations"][1]["T_station1_station"][0][3 if what == "frame" else 2] = number
    content = "".join([head, json.dumps(changed) + "\n", *others])
    for command in (("process",), ("calibrate", "motion", "--no-held-out")):
        refused(good, (*command, f"@{recording}"), recording, content, f"{recording}, line 2")


def test_frame_that_is_not_a_rotation_in_a_recording(good: dict[str, str]) -> None:
    """A scaled rotation is rejected although its numbers are small."""
    head, parameters, *others = good["r.jsonl"].splitlines(keepends=True)
    changed = json.loads(parameters)
    changed["stations"][1]["T_station1_station"][0][0] *= 0.9
    content = "".join([head, json.dumps(changed) + "\n", *others])
    refused(good, ("process", "@r.jsonl"), "r.jsonl", content, "which is not a rotation")


@pytest.mark.parametrize("number", ["1e300", "-1e300", "1e9"])
def test_absurd_prism_position(good: dict[str, str], number: str) -> None:
    """The error names the line."""
    content = re.sub(r"^\S+", number, good["sensor_positions.csv"])
    tracks = ("@trimble1.csv", "@trimble2.csv", "@trimble3.csv")
    arguments = ("import", "rts", "--tracks", *tracks, "--prisms", "@sensor_positions.csv")
    refused(good, arguments, "sensor_positions.csv", content, "sensor_positions.csv, line 1: ")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("20.1", "1e300", "line 3: slope_distance_m is '1e300'; expected at most 100000 m"),
        ("20.1", "1e6", "line 3: slope_distance_m is '1e6'; expected at most 100000 m"),
        (",10,1.0", ",1e300,1.0", "line 3: constant_mm is '1e300'; expected -10000 to 10000"),
        (",10,1.0", ",-1e300,1.0", "line 3: constant_mm is '-1e300'; expected -10000 to 10000"),
        ("1.0,0.0,0.5", "1.0,1e300,0.5", "line 3: y_m is '1e300'; expected"),
    ],
)
def test_absurd_target(good: dict[str, str], before: str, after: str, words: str) -> None:
    """The error names line, column and limits."""
    content = PRISM_LINES.replace(before, after)
    assert content != PRISM_LINES
    refused(good, ("calibrate", "prisms", "@prisms.csv"), "prisms.csv", content, words)


def test_absurd_distance_in_a_marker_file(good: dict[str, str]) -> None:
    """A distance of 10^12 m would make the equations singular."""
    lines = good["GCP.txt"].splitlines()
    cells = lines[1].split(",")
    lines[1] = ",".join([*cells[:5], " 1e12 ", *cells[6:]])
    refused(good, ("calibrate", "targets", "@GCP.txt"), "GCP.txt", "\n".join(lines), "GCP.txt, line 2: ")


@pytest.mark.parametrize("number", ["1e300", "-1e300"])
def test_absurd_reference(good: dict[str, str], number: str) -> None:
    """The error names the line."""
    *comments, first, second, third = good["r.tum"].splitlines(keepends=True)[:5]
    words = second.split()
    content = "".join([*comments, first, " ".join([words[0], number, *words[2:]]) + "\n", third])
    arguments = ("evaluate", "@r.jsonl", "--estimator", "linear", "--no-held-out", "--reference", "@r.tum")
    with Files({key: text.encode() for key, text in {**good, "r.tum": content}.items()}) as files:
        outcome = check_command(files, arguments)
    assert outcome.code == 1
    assert "line 4: is not a pose" in outcome.err


@pytest.mark.parametrize(
    ("scenario", "key", "number"),
    [
        *(
            (DYNAMIC, key, n)
            for key in ("area_centre_m", "position_m", "prism = 2\nposition_m")
            for n in ("1e300", "-1e9")
        ),
        (TRAIL, "route_m", "1e300"),
        (TRAIL, "route_m", "1e7"),
        (TRAIL, "corner_smoothing_m", "1e-300"),
        (DYNAMIC, "attitude_smoothing_s", "1e-300"),
        (DYNAMIC, "rate_hz", "1e-300"),
        (DYNAMIC, r"acceleration_sigma_mps2 = \[", "1e-300"),
        (DYNAMIC, "acceleration_correlation_time_s", "1e-300"),
        (DYNAMIC, "acceleration_correlation_time_s", "1e6"),
        (DYNAMIC, "interval_min_s", "1e-300"),
    ],
)
def test_absurd_scenario(scenario: str, key: str, number: str) -> None:
    """The error names the key."""
    with Files({"s.toml": with_number(scenario, key, number).encode()}) as files:
        outcome = check_command(files, ("simulate", "@s.toml", "--duration", "1"))
    assert outcome.code == 2, outcome
    assert re.findall(r"\w+_\w+", key)[0] in outcome.err


@pytest.mark.parametrize(
    "key", ["acceleration_correlation_time_s", "angular_acceleration_correlation_time_s"]
)
def test_absurd_motion_prior(good: dict[str, str], key: str) -> None:
    """Values outside the limits of the estimator are configuration errors."""
    content = with_number(MASTER, key, "1e-300")
    with Files({name: text.encode() for name, text in {**good, "c.toml": content}.items()}) as files:
        outcome = check_command(files, ("config", "check", "@c.toml"))
    assert outcome.code == 2
    assert f"pipeline.motion.{key}" in outcome.err


@pytest.mark.parametrize("millimetres", ["1e300", "-1e300", "10001"])
@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("calibrate", "targets", "x"), "--target-constant-mm"),
        (("calibrate", "prisms", "x"), "--target-constant-mm"),
        (("calibrate", "prisms", "x"), "--prism-constant-mm"),
        (("calibrate", "check", "x", "--config", "x"), "--target-constant-mm"),
        (("calibrate", "collect", "--config", "x"), "--target-constant-mm"),
        (("import", "rts"), "--target-constant-mm"),
        (("import", "rts"), "--prism-constant-mm"),
        (("import", "polar"), "--prism-constant-mm"),
    ],
)
def test_absurd_constant_is_a_usage_error(
    tsgt: Tsgt, command: tuple[str, ...], option: str, millimetres: str
) -> None:
    """No reflector adds ten metres."""
    outcome = tsgt(*command, option, millimetres)
    assert outcome.code == 2
    assert option in outcome.err
    assert "-10000<=x<=10000" in outcome.err


@pytest.mark.parametrize("option", [("--point", "1e300,0,0"), ("--area", "0", "1e12", "0", "30")])
def test_absurd_coordinate_is_a_usage_error(good: dict[str, str], option: tuple[str, ...]) -> None:
    """Exit code 2."""
    with Files({name: text.encode() for name, text in good.items()}) as files:
        assert check_command(files, ("analyse", "layout", "@prism_layout.example.toml", *option)).code == 2


def test_point_far_from_the_robot_is_an_error(good: dict[str, str]) -> None:
    """Its uncertainty would be meaningless."""
    with Files({name: text.encode() for name, text in good.items()}) as files:
        outcome = check_command(
            files,
            ("analyse", "layout", "@prism_layout.example.toml", "--point", "2e7,2e7,2e7"),
        )
    assert outcome.code == 1
    assert "the point is 3.4641e+07 m from the prisms" in outcome.err


@pytest.mark.parametrize("number", ["500000.0", "5500000.0", "-9999999.0"])
def test_map_coordinates_are_accepted(good: dict[str, str], number: str) -> None:
    """UTM coordinates have millions of metres on either hemisphere."""
    layout = re.sub(r"position_m = \[", f"position_m = [{number} + ", good["prism_layout.example.toml"])
    layout = re.sub(r"\[(\S+) \+ (-?[\d.]+)", lambda m: f"[{float(m[1]) + float(m[2])!r}", layout)
    frames = with_number(good["station_frames.example.toml"], re.escape("0.0, 0.0, 1.0,"), number)
    contents = {**good, "prism_layout.example.toml": layout, "station_frames.example.toml": frames}
    with Files({name: text.encode() for name, text in (contents | {"c.toml": MASTER}).items()}) as files:
        outcome = check_command(files, ("config", "check", "@c.toml"))
    assert outcome.code == 0, outcome


@pytest.mark.parametrize("sigma_ns", [10**15, 2**62])
def test_absurd_sigma_of_a_time(good: dict[str, str], sigma_ns: int) -> None:
    """Years of uncertainty at one station: its measurements have no weight, and no solver fails."""
    lines = [
        re.sub(r'"stamp_sigma_ns":\s*\d+', f'"stamp_sigma_ns":{sigma_ns}', line)
        if '"station":1' in line
        else line
        for line in good["r.jsonl"].splitlines()
    ]
    content = {**good, "r.jsonl": "\n".join(lines) + "\n"}
    assert content != good
    with Files({key: text.encode() for key, text in content.items()}) as files:
        assert check_command(files, ("process", "@r.jsonl"), output="o.tum").code == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("process", "/dev/zero"),
        ("evaluate", "@r.jsonl", "--reference", "/dev/zero"),
        ("compare", "@r.jsonl", "/dev/zero"),
        ("calibrate", "targets", "/dev/zero"),
        ("calibrate", "motion", "/dev/urandom"),
        ("export", "/dev/zero", "--format", "csv"),
        ("replay", "/dev/zero", "--no-wait"),
        ("simulate", "/dev/zero"),
        ("import", "rts", "--tracks", "/dev/zero", "/dev/zero", "/dev/zero", "--prisms", "/dev/zero"),
    ],
)
def test_endless_file_is_refused_before_it_is_read(good: dict[str, str], arguments: tuple[str, ...]) -> None:
    """A device is no file."""
    with Files({key: text.encode() for key, text in good.items()}) as files:
        outcome = check_command(files, arguments)
    assert outcome.code == 2
    assert "is a device" in outcome.err or "larger than 4 MB" in outcome.err
