"""The key file of a mission."""

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
    """Return a new key."""
    path = tmp_path / "radio.key"
    write_key(path)
    return path


def test_new_key_is_readable_by_its_owner_only(key: Path) -> None:
    """A new key has 32 bytes and mode 0600."""
    assert len(read_key(key)) == KEY_BYTES
    assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_keys_are_random(key: Path, tmp_path: Path) -> None:
    """Two keys differ."""
    write_key(tmp_path / "other.key")
    assert read_key(key) != read_key(tmp_path / "other.key")


@pytest.mark.parametrize(
    "made_up",
    [
        bytes(KEY_BYTES),
        b"\xff" * KEY_BYTES,
        bytes.fromhex("0123456789abcdef") * (KEY_BYTES // 8),
        bytes(range(KEY_BYTES)),
        bytes(range(KEY_BYTES, 0, -1)),
        b"correct horse battery staple 123"[:KEY_BYTES],
    ],
    ids=["zeros", "ones", "repeat", "up", "down", "sentence"],
)
def test_key_that_no_generator_made_is_rejected(key: Path, made_up: bytes) -> None:
    """Anybody can guess it."""
    key.write_text(made_up.hex() + "\n")
    with pytest.raises(ConfigError, match="its digits follow a pattern"):
        read_key(key)


def test_made_keys_are_accepted(tmp_path: Path) -> None:
    """Whatever the generator draws."""
    for number in range(50):
        write_key(tmp_path / f"{number}.key")
        assert len(read_key(tmp_path / f"{number}.key")) == KEY_BYTES


def test_key_is_not_overwritten(key: Path) -> None:
    """An existing key file stays unchanged."""
    before = key.read_text()
    with pytest.raises(OutputFileError, match="exists already"):
        write_key(key)
    assert key.read_text() == before


def test_missing_folder_is_reported(tmp_path: Path) -> None:
    """Writing a key requires an existing folder."""
    with pytest.raises(OutputFileError, match="No such file or directory"):
        write_key(tmp_path / "nowhere" / "radio.key")


def test_partial_key_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk leaves no partial key file behind."""

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputFileError, match="No space left"):
        write_key(tmp_path / "radio.key")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o700, 0o644])
def test_key_with_access_for_others_is_rejected(key: Path, mode: int) -> None:
    """The message contains the command that corrects the mode."""
    key.chmod(mode)
    with pytest.raises(ConfigError, match=rf"its mode is {mode:04o}.*`chmod 600 {key}`"):
        read_key(key)


def test_key_in_a_world_writable_folder_is_rejected(key: Path) -> None:
    """In a folder where all users may rename files, the key's own mode does not protect it."""
    key.parent.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"`chmod o-w {key.parent}`"):
        read_key(key)


def test_read_only_key_is_accepted(key: Path) -> None:
    """Mode 0400 is stricter and accepted."""
    key.chmod(0o400)
    assert len(read_key(key)) == KEY_BYTES


def test_key_of_another_user_is_rejected(key: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The owner could change the file; the message names both users."""
    owner = key.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 54321)
    with pytest.raises(ConfigError, match=rf"belongs to the user .*, here {owner + 54321}; .*chown"):
        read_key(key)


def test_key_of_a_named_owner_is_accepted(key: Path) -> None:
    """A check as root reads the key of the daemon's user."""
    owner = key.stat().st_uid
    assert read_key(key, owner=owner) == read_key(key)
    with pytest.raises(ConfigError, match=rf"here {owner + 54321}; .*chown"):
        read_key(key, owner=owner + 54321)


def test_missing_key_is_reported_with_the_command_that_creates_one(tmp_path: Path) -> None:
    """No key is created automatically: a new key on one machine would exclude all others."""
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
def test_invalid_content_is_rejected(key: Path, content: bytes) -> None:
    """A truncated copy or another file is no key."""
    key.write_bytes(content)
    with pytest.raises(ConfigError, match="not a key, which is one line of 64 hexadecimal digits"):
        read_key(key)


def test_white_space_is_ignored(key: Path) -> None:
    """An editor may add a line end."""
    before = read_key(key)
    key.write_text(f" {key.read_text().upper()}\r\n\n")
    assert read_key(key) == before


def test_link_is_checked_by_its_target(key: Path) -> None:
    """The target must belong to the user alone; a dangling link is a missing file."""
    link = key.parent / "link"
    link.symlink_to(key)
    assert read_key(link) == read_key(key)
    key.chmod(0o640)
    with pytest.raises(ConfigError, match="its mode is 0640"):
        read_key(link)
    key.unlink()
    with pytest.raises(ConfigError, match="no such file"):
        read_key(link)


def test_impossible_path_is_reported() -> None:
    """A configuration may contain any character."""
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(Path("radio\0.key"))


def test_folder_and_pipe_are_rejected(tmp_path: Path) -> None:
    """A folder is rejected, and a pipe does not block."""
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(ConfigError, match="not a file"):
            read_key(path)
