"""The page on programs that read wheel odometry agrees with the code."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from tsgt.config import OdometryConfig
from tsgt.imu import OdometryHelloLine, OdometryLine, decode_odometry_line

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "odometry-program.md").read_text()


def block(language: str) -> str:
    """Return the page's code block in a language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.mark.parametrize("line", [OdometryHelloLine, OdometryLine])
def test_tables_list_all_fields(line: type) -> None:
    """And no others."""
    (name,) = (field.default for field in dataclasses.fields(line) if field.name == "type")
    table = PAGE.split(f"### `{name}`")[1].split("\n## ")[0].split("\n### ")[0]
    rows = re.findall(r"^\| (`.*?`) \|", table, flags=re.MULTILINE)
    documented = {field for row in rows for field in re.findall(r"`(\w+)`", row)}
    assert documented == {field.name for field in dataclasses.fields(line)}


def test_examples_are_valid() -> None:
    """Lines that a program prints, and the configuration."""
    assert all(decode_odometry_line(line.encode()) is not None for line in block("json").splitlines())
    assert set(tomllib.loads(block("toml"))["odometry"]) <= set(OdometryConfig.model_fields)
