"""Permissions of the files that daemons read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tsgt.config import check_permissions
from tsgt.errors import ConfigError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return a file in a folder of its user."""
    folder = tmp_path / "mission"
    folder.mkdir(mode=0o755)
    file = folder / "frames.toml"
    file.touch(0o644)
    return file


@pytest.mark.parametrize("mode", [0o400, 0o600, 0o640, 0o644, 0o660, 0o664, 0o775])
def test_default_permissions_are_accepted(file: Path, mode: int) -> None:
    """Also with umask 002, where the user's own group may write."""
    file.chmod(mode)
    file.parent.chmod(0o775)
    check_permissions(file)


@pytest.mark.parametrize("mode", [0o602, 0o646, 0o666, 0o777])
def test_world_writable_file_is_rejected(file: Path, mode: int) -> None:
    """The command in the error fixes it."""
    file.chmod(mode)
    with pytest.raises(
        ConfigError, match=rf"everybody .* \(mode {mode:04o}\); `chmod o-w {file}`$"
    ) as refused:
        check_permissions(file)
    assert refused.value.path == file
    file.chmod(mode & ~0o002)
    check_permissions(file)


@pytest.mark.parametrize("above", [0, 1])
def test_file_in_a_world_writable_folder_is_rejected(file: Path, above: int) -> None:
    """The folder of the file, or one above."""
    folder = file.parents[above]
    folder.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"as {folder} has mode 0777; `chmod o-w {folder}`$"):
        check_permissions(file)


def test_own_file_in_a_sticky_folder_is_accepted(file: Path) -> None:
    """In /tmp nobody can rename the files of others."""
    file.parent.chmod(0o1777)
    check_permissions(file)
    check_permissions(file.rename(file.with_name("renamed.toml")))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_file_of_another_user_in_a_sticky_folder_is_rejected(file: Path) -> None:
    """Files of root are accepted."""
    os.chown(file, 12345, -1)
    check_permissions(file)  # in a folder of the user any owner is accepted
    file.parent.chmod(0o1777)
    check_permissions(file, user=12345)
    with pytest.raises(ConfigError, match=r"belongs to the user 12345 and lies in .* a folder of your own"):
        check_permissions(file, user=54321)
    os.chown(file, 0, -1)
    check_permissions(file, user=54321)


def test_link_and_its_target_are_both_checked(file: Path, tmp_path: Path) -> None:
    """Both could be replaced."""
    place = tmp_path / "place"
    place.mkdir()
    link = place / "link.toml"
    link.symlink_to(file)
    check_permissions(link)
    place.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"as {place} has mode"):
        check_permissions(link)
    place.chmod(0o755)
    file.chmod(0o666)
    with pytest.raises(ConfigError, match=r"link.toml: everybody"):
        check_permissions(link)


def test_missing_file_is_left_to_its_reader(tmp_path: Path) -> None:
    """Link cycles and invalid names do not fail here."""
    (tmp_path / "ring").symlink_to(tmp_path / "ring")
    for path in (tmp_path / "none", tmp_path / "ring", Path("a\0b")):
        check_permissions(path)
