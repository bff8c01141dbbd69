"""The page on programs that read an IMU agrees with the code."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from tsgt.config import ImuConfig
from tsgt.imu import HelloLine, SamplesLine, StatusLine, decode_program_line

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "imu-program.md").read_text()


def blocks(language: str) -> list[str]:
    """Return the page's code blocks in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("line", [HelloLine, SamplesLine, StatusLine])
def test_tables_list_all_fields(line: type) -> None:
    """And no others."""
    (name,) = (field.default for field in dataclasses.fields(line) if field.name == "type")
    table = PAGE.split(f"### `{name}`")[1].split("\n## ")[0].split("\n### ")[0]
    rows = re.findall(r"^\| (`.*?`) \|", table, flags=re.MULTILINE)
    documented = {field for row in rows for field in re.findall(r"`(\w+)`", row)}
    assert documented == {field.name for field in dataclasses.fields(line)}


def test_example_lines_decode() -> None:
    """Each that a program prints."""
    (printed,) = blocks("json")
    assert all(decode_program_line(line.encode()) is not None for line in printed.splitlines())


def test_example_script_works() -> None:
    """A shell runs it, and the master decodes its output."""
    (script,) = blocks("sh")
    run = subprocess.run(
        ["sh", "-c", script.replace("while sleep 0.1", "for _ in once twice")],  # noqa: S607
        capture_output=True,
        check=True,
    )
    hello, *others = map(decode_program_line, run.stdout.splitlines())
    assert isinstance(hello, HelloLine)
    assert [line.counter for line in others if isinstance(line, SamplesLine)] == [(0,), (1,)]


def test_example_configuration_is_valid() -> None:
    """The model takes it."""
    text = blocks("toml")[0]
    values = tomllib.loads(text)["imu"]
    assert set(values) <= set(ImuConfig.model_fields)
    assert "latitude_deg" in values
