"""Damaged recordings and journals: a result or an error in one line; never a partial file."""

from __future__ import annotations

import json
from collections import Counter

import pytest
from harness.files.authors_files import CONSTANTS, write_prisms, write_targets, write_tracks
from harness.files.cli import called
from harness.files.cli_contract import Files, check_command
from harness.files.damage import UNDAMAGED, Damage, Samples, damages, examples
from harness.missions.merging import journals, recording
from harness.missions.missions import QUICK, SUPERFRAME, run_mission
from hypothesis import example, given, settings
from hypothesis import strategies as st

FUZZ_EXAMPLES = 1000
"""Default number of examples, which distinguishes `make fuzz` from `make test`."""

KEPT_OF_A_TYPE = 40
"""Lines of a recording; a damaged one among thousands of poses would show the same."""


def shortened(content: bytes) -> bytes:
    """Drop most of the frequent lines."""
    seen: Counter[str] = Counter()
    kept = []
    for line in content.splitlines(keepends=True):
        kind = json.loads(line)["type"]
        seen[kind] += 1
        if kind == "measurement" or seen[kind] <= KEPT_OF_A_TYPE:
            kept.append(line)
    return b"".join(kept)


@pytest.fixture(scope="module")
def missions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Samples, ...]:
    """Twelve seconds with each protocol; the second recording lacks measurements as after a lossy radio."""
    samples = []
    for protocol in (SUPERFRAME, QUICK):
        folder = tmp_path_factory.mktemp(protocol.kind)
        run = run_mission(folder, duration_s=12.0, protocol=protocol)
        path = folder / "r.jsonl"
        contents = {
            "recording": recording(run, path).read_bytes(),
            "thinned": recording(run, path, without=4).read_bytes(),
        }
        contents |= {f"journal {path.parent.name}": path.read_bytes() for path in journals(run)}
        samples.append(Samples({name: shortened(content) for name, content in contents.items()}))
    return tuple(samples)


@pytest.fixture(scope="module")
def recordings(missions: tuple[Samples, ...], tmp_path_factory: pytest.TempPathFactory) -> Samples:
    """Return recordings of all kinds: of missions, merged ones, and what the authors published, as points and as angles."""
    folder = tmp_path_factory.mktemp("recordings")
    found = [sample.all[0] for sample in missions]
    for sample in missions:
        paths = [folder / f"{number}.jsonl" for number in range(len(sample.all) - 1)]
        for path, content in zip(paths, sample.all[1:], strict=True):
            path.write_bytes(content)
        assert called("merge", *paths).code == 0
        found.append(paths[0].read_bytes())
    tracks = ("--tracks", *write_tracks(folder), "--prisms", write_prisms(folder))
    for targets in ((), ("--targets", write_targets(folder), *CONSTANTS)):
        path = folder / "imported.jsonl"
        assert called("import", "rts", *tracks, *targets, "--output", path).code == 0
        found.append(path.read_bytes())
    return Samples({f"recording {number}": content for number, content in enumerate(found)})


COMMANDS: dict[str, tuple[tuple[str, ...], str]] = {
    "process": (("process", "@input", "--estimator", "linear"), "o.tum"),
    "process continuous": (("process", "@input", "--estimator", "continuous"), "o.jsonl"),
    "evaluate": (("evaluate", "@input", "--estimator", "linear", "--json"), ""),
    "export tum": (("export", "@input", "--format", "tum"), "o.tum"),
    "export csv": (("export", "@input", "--format", "csv", "--records", "measurements"), "o.csv"),
    "export mcap": (("export", "@input", "--format", "mcap"), "o.mcap"),
    "replay": (("replay", "@input", "--no-wait", "--speed", "inf", "--socket", "@socket"), ""),
    "calibrate motion": (("calibrate", "motion", "@input", "--no-held-out"), "o.toml"),
}


@pytest.mark.parametrize("command", COMMANDS)
@examples(2)
@given(damage=damages, keep_going=st.booleans())
@example(damage=UNDAMAGED, keep_going=False)
@pytest.mark.slow
def test_commands_with_a_damaged_recording(
    recordings: Samples,
    command: str,
    damage: Damage,
    keep_going: bool,  # noqa: FBT001 (given by hypothesis)
) -> None:
    """Commands with a damaged recording."""
    arguments, output = COMMANDS[command]
    with Files({"input": damage.to(recordings.all)}) as files:
        outcome = check_command(files, arguments, output=output, extra=("--keep-going",) * keep_going)
    assert damage != UNDAMAGED or outcome.code in (0, 3), outcome


@pytest.mark.slow
@examples(2)
@given(of=st.integers(0, 1), recording_damage=damages, journal_damage=damages, keep_going=st.booleans())
def test_merge_of_damaged_journals(
    missions: tuple[Samples, ...],
    of: int,
    recording_damage: Damage,
    journal_damage: Damage,
    keep_going: bool,  # noqa: FBT001 (as above)
) -> None:
    """Merge of damaged journals."""
    _, recording, *journals = missions[of].all
    contents = {
        "recording": recording_damage.to([recording]),
        "one": journal_damage.to(journals),
        "two": journals[1],
    }
    with Files(contents) as files:
        extra = ("--keep-going",) * keep_going
        check_command(files, ("merge", "@recording", "@one", "@two"), output="merged.jsonl", extra=extra)


ODOMETRY = [
    b"time_s,linear_mps,angular_radps\n" + b"".join(b"%d.5,0.0,0.0\n" % (1_700_000_000 + k) for k in range(9))
]


@pytest.mark.skipif(settings().max_examples < FUZZ_EXAMPLES, reason="takes seconds each time; for make fuzz")
@examples(1)
@given(damage=damages, odometry_damage=damages)
@example(damage=UNDAMAGED, odometry_damage=UNDAMAGED)
def test_report_of_a_damaged_recording(recordings: Samples, damage: Damage, odometry_damage: Damage) -> None:
    """Report of a damaged recording."""
    with Files({"input": damage.to(recordings.all), "odometry": odometry_damage.to(ODOMETRY)}) as files:
        odometry = ("--odometry", "@odometry") if damage.sample % 2 else ()
        arguments = ("evaluate", "@input", "--estimator", "linear", "--no-held-out", "--report", "@report")
        outcome = check_command(files, (*arguments, *odometry), output="report")
    assert damage.edits or outcome.code == 0, outcome
