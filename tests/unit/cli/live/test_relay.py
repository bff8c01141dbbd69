"""``tsgt relay``: options and files. The server is tested in tests/unit/relay."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt


def test_key_is_made_for_its_owner_alone(tsgt: Tsgt, tmp_path: Path) -> None:
    """An existing one is never overwritten."""
    path = tmp_path / "relay.key"
    assert tsgt("relay", "--make-key", path).code == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    key = path.read_bytes()
    assert tsgt("relay", "--make-key", path).code == 1
    assert path.read_bytes() == key


def test_missing_key_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """It names the command that makes one."""
    outcome = tsgt("relay", "--key", tmp_path / "relay.key")
    assert outcome.code == 2
    assert "tsgt relay --make-key" in outcome.err


@pytest.mark.parametrize("address", ["robot", "10.0.0.1:99999", "10.0.0", "1::2::3", "10.0.0.1:x", ""])
def test_bad_addresses_are_usage_errors(tsgt: Tsgt, tmp_path: Path, address: str) -> None:
    """Names are not looked up: which interface they mean may change."""
    outcome = tsgt("relay", "--key", tmp_path / "k", "--listen", address)
    assert outcome.code == 2
    assert "is not ADDRESS" in outcome.err


def test_hold_of_no_number_is_a_usage_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """Before anything is opened."""
    tsgt("relay", "--make-key", tmp_path / "k")
    outcome = tsgt("relay", "--key", tmp_path / "k", "--hold-s", "nan")
    assert outcome.code == 2
    assert "nan is not a finite number" in outcome.err


def test_address_of_another_computer_is_an_error(tsgt: Tsgt, tmp_path: Path) -> None:
    """One line says what to do."""
    tsgt("relay", "--make-key", tmp_path / "k")
    outcome = tsgt("relay", "--key", tmp_path / "k", "--listen", "203.0.113.7")
    assert outcome.code == 1
    assert "203.0.113.7:27690: cannot listen there" in outcome.err


def test_certificate_needs_its_private_key(tsgt: Tsgt, tmp_path: Path) -> None:
    """And both have to be what they say."""
    tsgt("relay", "--make-key", tmp_path / "k")
    outcome = tsgt("relay", "--key", tmp_path / "k", "--certificate", tmp_path / "k")
    assert outcome.code == 2
    assert "give --certificate and --private-key together" in outcome.err
    outcome = tsgt(
        "relay", "--key", tmp_path / "k", "--certificate", tmp_path / "k", "--private-key", tmp_path / "k"
    )
    assert outcome.code == 2
    assert "cannot be used" in outcome.err
