"""The file with the key of a mission."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from tsgt.errors import ConfigError, OutputFileError
from tsgt.radio.key_file import read_key, write_key
from tsgt.radio.superframe.wire import KEY_BYTES


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """Return a key as it is made."""
    path = tmp_path / "radio.key"
    write_key(path)
    return path


def test_a_new_key_can_be_read_by_its_owner_only(key: Path) -> None:
    """It has its 32 bytes, and nobody else has a right to the file."""
    assert len(read_key(key)) == KEY_BYTES
    assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_each_key_is_another_one(key: Path, tmp_path: Path) -> None:
    """Keys are random."""
    write_key(tmp_path / "other.key")
    assert read_key(key) != read_key(tmp_path / "other.key")


def test_a_key_is_not_overwritten(key: Path) -> None:
    """The key of a mission that is on its way would be lost."""
    before = key.read_text()
    with pytest.raises(OutputFileError, match="exists already"):
        write_key(key)
    assert key.read_text() == before


def test_where_no_key_can_be_written_is_said(tmp_path: Path) -> None:
    """There has to be a folder."""
    with pytest.raises(OutputFileError, match="No such file or directory"):
        write_key(tmp_path / "nowhere" / "radio.key")


def test_half_a_key_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk leaves no file behind that looks like a key."""

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputFileError, match="No space left"):
        write_key(tmp_path / "radio.key")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o700, 0o644])
def test_a_key_that_others_may_use_is_refused(key: Path, mode: int) -> None:
    """The message gives the command that mends it."""
    key.chmod(mode)
    with pytest.raises(ConfigError, match=rf"its mode is {mode:04o}.*`chmod 600 {key}`"):
        read_key(key)


def test_a_key_that_everybody_may_replace_is_refused(key: Path) -> None:
    """Its own mode helps nothing where everybody may rename files."""
    key.parent.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"`chmod o-w {key.parent}`"):
        read_key(key)


def test_a_key_that_cannot_be_changed_is_good(key: Path) -> None:
    """Read-only for its owner is stricter still."""
    key.chmod(0o400)
    assert len(read_key(key)) == KEY_BYTES


def test_the_key_of_somebody_else_is_refused(key: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever owns the file could change it; the message names both users."""
    owner = key.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 54321)
    with pytest.raises(ConfigError, match=rf"belongs to the user .*, here {owner + 54321}; .*chown"):
        read_key(key)


def test_a_key_may_be_that_of_another_user_who_is_named(key: Path) -> None:
    """Whoever checks a machine as root looks at the key of the daemon's user."""
    owner = key.stat().st_uid
    assert read_key(key, owner=owner) == read_key(key)
    with pytest.raises(ConfigError, match=rf"here {owner + 54321}; .*chown"):
        read_key(key, owner=owner + 54321)


def test_a_missing_key_is_said_with_the_command_that_makes_one(tmp_path: Path) -> None:
    """Nothing is made by itself: a new key on one machine would shut out all others."""
    with pytest.raises(ConfigError, match=r"no such file; .*`tsgt radio key"):
        read_key(tmp_path / "radio.key")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"secret\n",
        b"00" * (KEY_BYTES - 1),
        b"00" * (KEY_BYTES + 1),
        b"\xff" * 5000,
        b"0x" * 32,
        b"00" * KEY_BYTES + b" " * 1000 + b"x",
    ],
)
def test_what_is_no_key_is_refused(key: Path, content: bytes) -> None:
    """A torn copy or another file is no key."""
    key.write_bytes(content)
    with pytest.raises(ConfigError, match="not a key, which is one line of 64 hexadecimal digits"):
        read_key(key)


def test_white_space_does_not_matter(key: Path) -> None:
    """An editor or a mail may add an end of line."""
    before = read_key(key)
    key.write_text(f" {key.read_text().upper()}\r\n\n")
    assert read_key(key) == before


def test_a_link_to_a_key_is_as_good_as_what_it_leads_to(key: Path) -> None:
    """Its file has to belong to the user and to be his alone; one that leads nowhere is no file."""
    link = key.parent / "link"
    link.symlink_to(key)
    assert read_key(link) == read_key(key)
    key.chmod(0o640)
    with pytest.raises(ConfigError, match="its mode is 0640"):
        read_key(link)
    key.unlink()
    with pytest.raises(ConfigError, match="no such file"):
        read_key(link)


def test_a_path_that_cannot_be_is_said() -> None:
    """A configuration may hold any character."""
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(Path("radio\0.key"))


def test_only_a_file_is_a_key(tmp_path: Path) -> None:
    """A folder is refused, and a pipe is not waited for."""
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(ConfigError, match="not a file"):
            read_key(path)
