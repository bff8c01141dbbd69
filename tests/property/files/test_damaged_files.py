"""Damaged files of post-processing: a result, or one line with the error; never a partial output file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks
from harness.files.cli import called
from harness.files.cli_contract import Files, check_command
from harness.files.damage import UNDAMAGED, Damage, Samples, damages, examples
from harness.files.pos_files import SECOND, write_pos
from hypothesis import example, given
from hypothesis import strategies as st

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs"
EXAMPLES = [path.read_bytes() for path in sorted(CONFIGS.rglob("*.toml"))]
LAYOUT = (CONFIGS / "prism_layout.example.toml").read_bytes()
FRAMES = (CONFIGS / "station_frames.example.toml").read_bytes()
MASTERS = [path.read_bytes() for path in sorted(CONFIGS.glob("master*.toml"))]
SCENARIOS = [path.read_bytes() for path in sorted((CONFIGS / "scenarios").glob("*.toml"))]
DOCUMENTED = [
    example.encode()
    for example in re.findall(
        r"```csv\n(.*?)```", (ROOT / "docs" / "reference" / "target-file.md").read_text("utf-8"), re.DOTALL
    )
]
KEY = b"0123456789abcdef" * 4 + b"\n"
SETUP = {"prism_layout.example.toml": LAYOUT, "station_frames.example.toml": FRAMES, "radio.key": KEY}
START_S = 1_700_000_000
"""When the authors' tracks begin."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    """Return one valid file of each kind."""
    folder = tmp_path_factory.mktemp("good")
    tracks = write_tracks(folder, duration_s=6.0)
    write_prisms(folder)
    write_targets(folder)
    assert (
        called(
            *("import", "rts", "--tracks", *tracks, "--prisms", folder / "sensor_positions.csv"),
            *("--targets", folder / "GCP.txt", *CONSTANTS, "--output", folder / "r.jsonl"),
        ).code
        == 0
    )
    frames = folder / "frames.toml"
    assert (
        called(
            *("calibrate", "targets", folder / "GCP.txt", "--target-constant-mm", "0", "--output", frames)
        ).code
        == 0
    )
    assert called("process", folder / "r.jsonl", "--output", folder / "r.tum").code == 0
    (folder / "polar.csv").write_text(
        called("export", folder / "r.jsonl", "--format", "csv", "--records", "measurements").out
    )
    times_ns = [START_S * SECOND + k * SECOND // 2 for k in range(12)]
    for number in (1, 2):
        places = np.array([[k, number, 2.0] for k in range(len(times_ns))])
        write_pos(folder / f"{number}.pos", times_ns, places)
    odometry = "time_s,linear_mps,angular_radps\n" + "".join(f"{START_S + k / 2},0.0,0.0\n" for k in range(9))
    (folder / "odometry.csv").write_text(odometry)
    return Samples({path.name: path.read_bytes() for path in folder.iterdir()} | SETUP)


IMPORT = ("import", "rts", "--tracks", "@trimble1.csv", "@trimble2.csv", "@trimble3.csv")
EVALUATE = ("evaluate", "@r.jsonl", "--estimator", "linear", "--json")
COMMANDS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "tracks": ((*IMPORT, "--prisms", "@sensor_positions.csv"), "trimble2.csv", "o.jsonl"),
    "published prisms": ((*IMPORT, "--prisms", "@sensor_positions.csv"), "sensor_positions.csv", "o.jsonl"),
    "published targets": (
        (*IMPORT, "--prisms", "@sensor_positions.csv", "--targets", "@GCP.txt", *CONSTANTS),
        "GCP.txt",
        "o.jsonl",
    ),
    "raw measurements": (
        (
            *("import", "polar", "--tracks", "@polar.csv", "--prisms", "@sensor_positions.csv"),
            *("--frames", "@frames.toml", "--prism-constant-mm", "10"),
        ),
        "polar.csv",
        "o.jsonl",
    ),
    "marker file": (("calibrate", "targets", "@GCP.txt", *CONSTANTS[:2]), "GCP.txt", "o.toml"),
    "receivers": (("analyse", "gnss", "@1.pos", "@2.pos", "--recording", "@r.jsonl"), "2.pos", ""),
    "reference": ((*EVALUATE, "--reference", "@r.tum"), "r.tum", ""),
    "reference exported": (
        ("export", "@r.jsonl", "--format", "mcap", "--reference", "@r.tum"),
        "r.tum",
        "o.mcap",
    ),
    "frames": (("process", "@r.jsonl", "--frames", "@frames.toml"), "", "o.tum"),
    "layout": (("process", "@r.jsonl", "--prisms", "@prism_layout.example.toml"), "", "o.tum"),
}


@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=pytest.mark.slow) if c == "reference" else c for c in COMMANDS]
)
@examples(3)
@given(damage=damages)
@example(damage=UNDAMAGED)
def test_damaged_data_files(good: Samples, command: str, damage: Damage) -> None:
    """Data and set-up files: each command succeeds with a damaged one or rejects it."""
    arguments, name, output = COMMANDS[command]
    name = name or arguments[-1].removeprefix("@")
    with Files({**good.of, name: damage.to([good.of[name]])}) as files:
        outcome = check_command(files, arguments, output=output)
    assert damage.edits or outcome.code == 0, outcome


@examples(15)
@given(damage=damages, command=st.sampled_from(["targets", "prisms"]), levelled=st.booleans())
def test_damaged_target_files(damage: Damage, command: str, levelled: bool) -> None:  # noqa: FBT001 (given by hypothesis)
    """Our CSV and the authors' marker file, in all forms of the reference page."""
    with Files({"measured.csv": damage.to(DOCUMENTED)}) as files:
        extra = ("--levelled",) * (levelled and command == "targets")
        check_command(files, ("calibrate", command, "@measured.csv"), output="o.toml", extra=extra)


@examples(40)
@given(damage=damages)
def test_damaged_configurations(damage: Damage) -> None:
    """Every example configuration, damaged, is valid or one line of error."""
    with Files({**SETUP, "c.toml": damage.to(EXAMPLES)}) as files:
        check_command(files, ("config", "check", "@c.toml"))


@examples(15)
@given(damage=damages, master=st.sampled_from(MASTERS), name=st.sampled_from(sorted(SETUP)))
@pytest.mark.slow
def test_damaged_files_named_by_a_configuration(damage: Damage, master: bytes, name: str) -> None:
    """A valid configuration with a damaged set-up file."""
    with Files({**SETUP, name: damage.to([SETUP[name]]), "c.toml": master}) as files:
        check_command(files, ("config", "check", "@c.toml"))


@examples(1)
@given(damage=damages)
def test_damaged_studies(damage: Damage) -> None:
    """A damaged layout or scenario is evaluated or rejected."""
    content = damage.to([LAYOUT, *SCENARIOS])
    with Files({"f.toml": content}) as files:
        if b'kind = "scenario"' in content:
            check_command(files, ("analyse", "layout", "--scenario", "@f.toml"))
        else:
            check_command(
                files,
                ("analyse", "perturbation", "--step-mm", "200", "--samples", "3", "--prisms", "@f.toml"),
            )
            check_command(files, ("analyse", "layout", "@f.toml"))
