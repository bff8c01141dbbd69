"""The page on the bridge agrees with the code."""

from __future__ import annotations

import dataclasses
import re
import subprocess
from pathlib import Path

import pytest

from tsgt.config import BridgeInstrumentConfig
from tsgt.station.bridge.messages import (
    AtmosphereLine,
    CommandLine,
    DirectLine,
    DoneLine,
    HelloLine,
    MeasureLine,
    MeasurementLine,
    SettingsLine,
    SingleMeasurementLine,
    StatusLine,
    TrackLine,
    decode_program_line,
)

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "bridge.md").read_text()

COMMANDS: dict[str, type[CommandLine]] = {
    "track": TrackLine,
    "direct": DirectLine,
    "measure": MeasureLine,
    "atmosphere": AtmosphereLine,
}


def blocks(language: str) -> list[str]:
    """Return the page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("line", [HelloLine, MeasurementLine, DoneLine, StatusLine, SettingsLine])
def test_tables_list_all_fields(line: type) -> None:
    """And no others."""
    (name,) = (field.default for field in dataclasses.fields(line) if field.name == "type")
    table = PAGE.split(f"### `{name}`")[1].split("\n## ")[0].split("\n### ")[0]
    rows = re.findall(r"^\| (`.*?`) \|", table, flags=re.MULTILINE)
    documented = {field for row in rows for field in re.findall(r"`(\w+)`", row)}
    assert documented == {field.name for field in dataclasses.fields(line)}


def test_shot_has_fields_of_measurement() -> None:
    """All but the prism, and an id."""
    shot, measurement = (
        {field.name for field in dataclasses.fields(line)}
        for line in (SingleMeasurementLine, MeasurementLine)
    )
    assert shot == measurement - {"prism"} | {"id"}


def test_command_table_lists_all_fields() -> None:
    """Type, and the second column."""
    for name, command in COMMANDS.items():
        fields = re.search(rf"^\| `{name}` \| (.*?) \|", PAGE, flags=re.MULTILINE)
        assert fields is not None
        documented = {"type", *re.findall(r"`(\w+)`", fields[1])}
        assert documented == {field.name for field in dataclasses.fields(command)}


def test_example_lines_decode() -> None:
    """Each that a program prints."""
    printed = blocks("json")[1].splitlines()
    assert all(decode_program_line(line.encode()) is not None for line in printed)


def test_example_script_works() -> None:
    """A shell runs it, and the client decodes its output."""
    (script,) = blocks("sh")
    run = subprocess.run(
        ["sh", "-c", script.replace("while sleep 0.4", "for _ in once")],  # noqa: S607
        capture_output=True,
        check=True,
    )
    hello, measurement = map(decode_program_line, run.stdout.splitlines())
    assert isinstance(hello, HelloLine)
    assert isinstance(measurement, MeasurementLine)


def test_example_configuration_is_valid() -> None:
    """Its keys are those of the configuration."""
    (block,) = blocks("toml")
    keys = set(re.findall(r"^(\w+) =", block, flags=re.MULTILINE))
    assert keys == set(BridgeInstrumentConfig.model_fields)
