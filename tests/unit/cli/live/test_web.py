"""``tsgt web``: its options. The page itself is tested in unit/web and process/readers/test_web.py."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest
from harness.files.cli import called

from tsgt.errors import ConfigError
from tsgt.web.code_file import read_code

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("address", ["0.0.0.0", "192.168.4.1", "::", "fe80::1%wlan0"])  # noqa: S104 (that is the point)
def test_address_without_a_code_is_refused(address: str) -> None:
    """Other computers get in with an access code only; the message says how to make one."""
    outcome = called("web", "--listen", address)
    assert outcome.code == 2
    assert "--code-file" in outcome.err
    assert "/dev/urandom" in outcome.err


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--listen", "robot.local"), "no IP address"),
        (("--replay", "r.jsonl", "--socket", "s"), "give one of them"),
        (("--key", "k.pem"), "--certificate"),
        (("--replay", "r.jsonl", "--foxglove"), "tsgt export"),
    ],
)
def test_impossible_options_are_refused(arguments: tuple[str, ...], word: str) -> None:
    """With what to do instead."""
    outcome = called("web", *arguments)
    assert outcome.code == 2
    assert word in outcome.err


def test_missing_foxglove_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, before anything is served."""
    monkeypatch.setitem(sys.modules, "foxglove", None)
    outcome = called("web", "--foxglove", "--port", "0")
    assert outcome.code == 1
    assert "tsgt[foxglove]" in outcome.err


@pytest.mark.parametrize("content", [b"short", b"", b"two\nlines of it", b"\xff" * 12 + b"\x00", b"x" * 300])
def test_code_that_is_none_is_refused(tmp_path: Path, content: bytes) -> None:
    """Too short to resist guessing, or nothing that one can type in."""
    path = tmp_path / "web.code"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="characters"):
        read_code(path)


def test_credential_of_the_service_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Systemd gives it to the service's user by an access control list, which looks like a mode of 0440."""
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    path = tmp_path / "web.code"
    path.write_text("abcdefghjk23")
    path.chmod(0o440)
    assert read_code(path) == "abcdefghjk23"


def test_code_file_is_for_its_owner_alone(tmp_path: Path) -> None:
    """As a key."""
    path = tmp_path / "web.code"
    path.write_text("abcdefghjk23\n")
    path.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        read_code(path)
    path.chmod(0o600)
    assert read_code(path) == "abcdefghjk23"


def test_missing_code_file_is_one_line(tmp_path: Path) -> None:
    """Not a traceback."""
    with pytest.raises(ConfigError, match="No such file"):
        read_code(tmp_path / "web.code")
