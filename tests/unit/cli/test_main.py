"""``tsgt --help``, and rules that all commands share: output formats, and optional dependencies."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import click
import numpy as np
import pytest
from harness.files.records import POSE, recording_bytes

from tsgt.cli.main import COMMANDS, GROUPS, HELP_OPTIONS, cli, run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from harness.files.cli import Tsgt


def groups() -> Iterator[tuple[str, click.Group]]:
    """Yield every group of commands."""
    yield "tsgt", cli
    context = click.Context(cli, **HELP_OPTIONS)
    for name in COMMANDS:
        command = cli.get_command(context, name)
        if isinstance(command, click.Group):
            yield name, command


def test_help_groups_the_commands(tsgt: Tsgt) -> None:
    """By who needs them: field, desk, planning, development."""
    lines = tsgt("--help").out.splitlines()
    assert [line for line in lines if line[:-1] in GROUPS] == [f"{heading}:" for heading in GROUPS]
    for name, (_, summary) in COMMANDS.items():
        assert any(line.split(maxsplit=1) == [name, summary] for line in lines), name


@pytest.mark.parametrize("group", list(groups()), ids=lambda each: each[0])
def test_help_of_sub_commands_is_not_cut_off(group: tuple[str, click.Group]) -> None:
    """On a terminal with 80 columns."""
    name, command = group
    text = command.get_help(click.Context(command, info_name=name, terminal_width=80, **HELP_OPTIONS))
    assert not [line for line in text.splitlines() if line.endswith("...") and not line.startswith("Usage")]


@pytest.mark.parametrize("name", COMMANDS)
def test_summary_is_the_first_sentence_of_the_help(name: str) -> None:
    """The summary is stored apart, so that ``tsgt --help`` imports no command."""
    command = cli.get_command(click.Context(cli, **HELP_OPTIONS), name)
    assert command is not None
    assert (command.help or "").partition("\n")[0] == COMMANDS[name][1]


@pytest.mark.parametrize("group", list(groups()), ids=lambda each: each[0])
def test_each_option_has_a_name_of_its_own(group: tuple[str, click.Group]) -> None:
    """Two options of one name would overwrite each other, as where a command adds options that others share."""
    _, parent = group
    context = click.Context(parent, **HELP_OPTIONS)
    for name in parent.list_commands(context):
        command = parent.get_command(context, name)
        assert command is not None
        names = [parameter.name for parameter in command.params]
        assert len(set(names)) == len(names), name


def test_help_imports_no_command() -> None:
    """It starts fast on a small computer."""
    program = "from tsgt.cli.main import cli; import sys; cli(['--help'], standalone_mode=False)"
    check = f"{program}; sys.exit(bool({{'numpy', 'scipy', 'rich'}} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", check], check=False, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (("process", "r.jsonl", "--output"), ".tum, .jsonl, .json, .csv"),
        (("export", "r.jsonl", "--output"), ".tum, .csv, .mcap"),
        (("merge", "r.jsonl", "j.jsonl", "--output"), ".jsonl, .json"),
        (("simulate", "--output"), ".jsonl, .json"),
        (("simulate", "--truth"), ".tum"),
        (("demo", "--output"), ".jsonl, .json"),
        (("import", "rts", "--output"), ".jsonl, .json"),
        (("import", "polar", "--output"), ".jsonl, .json"),
        (("calibrate", "targets", "t.csv", "--output"), ".toml"),
        (("calibrate", "prisms", "t.csv", "--output"), ".toml"),
        (("calibrate", "motion", "r.jsonl", "--output"), ".toml"),
        (("calibrate", "motion", "r.jsonl", "--prism-output"), ".toml"),
        (("calibrate", "collect", "--output"), ".csv"),
        (("analyse", "perturbation", "--figure"), ".png, .pdf, .svg"),
        (("analyse", "layout", "--figure"), ".png, .pdf, .svg"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
@pytest.mark.parametrize("name", ["out.xyz", "out"])
def test_unknown_suffix_is_rejected(
    tsgt: Tsgt, tmp_path: Path, arguments: tuple[str, ...], known: str, name: str
) -> None:
    """Exit code 2 before any work; the error lists the known suffixes."""
    outcome = tsgt(*arguments, tmp_path / name)
    assert outcome.code == 2
    assert f"known suffixes: {known}" in " ".join(outcome.err.split())
    assert list(tmp_path.iterdir()) == []


def test_export_format_follows_from_the_suffix(tsgt: Tsgt, tmp_path: Path) -> None:
    """--format overrides it."""
    recording = tmp_path / "poses.jsonl"
    recording.write_bytes(recording_bytes(POSE))
    for name, options, first in (
        ("a.tum", (), "# robot"),
        ("b.csv", (), "stamp_ns,"),
        ("c", ("--format", "tum"), "# robot"),
    ):
        assert tsgt("export", recording, "--output", tmp_path / name, *options) == (0, "", "")
        assert (tmp_path / name).read_text().startswith(first)
    assert tsgt("export", recording).code == 2


@pytest.mark.parametrize(
    ("library", "arguments", "extra"),
    [
        ("matplotlib", ("evaluate", "none.jsonl", "--report", "folder"), "report"),
        ("matplotlib", ("analyse", "perturbation", "--figure", "f.png"), "report"),
        ("mcap.writer", ("export", "none.jsonl", "--output", "o.mcap"), "mcap"),
        ("pymap3d", ("analyse", "gnss", "a.pos", "b.pos"), "gnss"),
    ],
)
def test_missing_library_is_reported_before_the_work(
    tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch, library: str, arguments: tuple[str, ...], extra: str
) -> None:
    """Exit code 1 and one line, even before the input is read."""
    monkeypatch.setitem(sys.modules, library, None)
    outcome = tsgt(*arguments)
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1)
    assert f"pip install 'tsgt[{extra}]'" in outcome.err


@pytest.mark.parametrize(
    ("error", "words"),
    [(np.linalg.LinAlgError("Singular matrix"), "Singular matrix"), (MemoryError(), "memory")],
)
def test_failure_of_a_solver_is_one_line(
    error: Exception, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """And so is memory that is not sufficient."""

    @click.command()
    def fail() -> None:
        raise error

    with pytest.raises(SystemExit) as ending:
        run(fail, [])
    assert ending.value.code == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err
