"""``tsgt radio key``, and how the daemons read the key."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.cli.composition import radio_key
from tsgt.config import ClassicConfig, SuperframeConfig, SuperframeMasterConfig
from tsgt.errors import ConfigError
from tsgt.radio.key_file import read_key

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


def test_key_command_writes_a_key_and_prints_instructions(tsgt: Tsgt, tmp_path: Path) -> None:
    """The text names the configuration keys; the key itself is not printed."""
    path = tmp_path / "mission.key"
    outcome = tsgt("radio", "key", path)
    assert outcome.code == 0
    assert 'key_file = "radio.key"' in outcome.out
    assert "mission.key /etc/tsgt/radio.key" in outcome.out
    assert read_key(path).hex() not in outcome.out


def test_existing_key_is_not_overwritten(tsgt: Tsgt, tmp_path: Path) -> None:
    """Exit code 1 and one line."""
    path = tmp_path / "mission.key"
    path.write_text("precious")
    outcome = tsgt("radio", "key", path)
    assert outcome.code == 1
    assert "exists already" in outcome.err
    assert path.read_text() == "precious"


def test_daemons_read_the_configured_key(tsgt: Tsgt, tmp_path: Path) -> None:
    """None is configured, or the protocol has none: no key."""
    path = tmp_path / "mission.key"
    tsgt("radio", "key", path)
    assert radio_key(SuperframeConfig(kind="superframe", key_file=path)) == read_key(path)
    assert radio_key(SuperframeMasterConfig(kind="superframe", key_file=path)) == read_key(path)
    assert radio_key(SuperframeConfig(kind="superframe")) is None
    assert radio_key(ClassicConfig(kind="classic")) is None


def test_configured_key_must_exist(tmp_path: Path) -> None:
    """A daemon does not run without the configured key."""
    with pytest.raises(ConfigError, match="no such file"):
        radio_key(SuperframeConfig(kind="superframe", key_file=tmp_path / "mission.key"))


def test_command_for_a_name_with_blanks_is_quoted(tsgt: Tsgt, tmp_path: Path) -> None:
    """It is pasted into a shell."""
    outcome = tsgt("radio", "key", tmp_path / "my key")
    assert "-m 600 'my key' /etc/tsgt/radio.key" in outcome.out
