"""The command that makes a key, and how the daemons come by theirs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.cli.composition import radio_key
from tsgt.config import ClassicConfig, SuperframeConfig, SuperframeMasterConfig
from tsgt.errors import ConfigError
from tsgt.radio.key_file import read_key

if TYPE_CHECKING:
    from pathlib import Path

    from harness.cli import Tsgt


def test_a_key_is_made_and_what_to_do_with_it_is_said(tsgt: Tsgt, tmp_path: Path) -> None:
    """The file is there, the text names what the configurations need, and the key itself is not printed."""
    path = tmp_path / "mission.key"
    outcome = tsgt("radio", "key", path)
    assert outcome.code == 0
    assert 'key_file = "radio.key"' in outcome.out
    assert "mission.key /etc/tsgt/radio.key" in outcome.out
    assert read_key(path).hex() not in outcome.out


def test_an_existing_file_is_left_alone(tsgt: Tsgt, tmp_path: Path) -> None:
    """One line says so, and the exit code is 1."""
    path = tmp_path / "mission.key"
    path.write_text("precious")
    outcome = tsgt("radio", "key", path)
    assert outcome.code == 1
    assert "exists already" in outcome.err
    assert path.read_text() == "precious"


def test_a_configuration_leads_to_its_key(tsgt: Tsgt, tmp_path: Path) -> None:
    """Both daemons get the key that their file names, and none where none is named or the protocol has none."""
    path = tmp_path / "mission.key"
    tsgt("radio", "key", path)
    assert radio_key(SuperframeConfig(kind="superframe", key_file=path)) == read_key(path)
    assert radio_key(SuperframeMasterConfig(kind="superframe", key_file=path)) == read_key(path)
    assert radio_key(SuperframeConfig(kind="superframe")) is None
    assert radio_key(ClassicConfig(kind="classic")) is None


def test_a_key_that_is_named_must_be_there(tmp_path: Path) -> None:
    """A daemon does not go on without the key that it was to have."""
    with pytest.raises(ConfigError, match="no such file"):
        radio_key(SuperframeConfig(kind="superframe", key_file=tmp_path / "mission.key"))
