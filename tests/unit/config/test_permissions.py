"""Files that everybody can change are not believed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tsgt.config import check_trust
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
def test_what_systems_make_by_default_is_believed(file: Path, mode: int) -> None:
    """Also with umask 002, where a user's own group may write what he makes, and in such a folder."""
    file.chmod(mode)
    file.parent.chmod(0o775)
    check_trust(file)


@pytest.mark.parametrize("mode", [0o602, 0o646, 0o666, 0o777])
def test_what_everybody_may_write_is_refused(file: Path, mode: int) -> None:
    """With the command that mends it, which does."""
    file.chmod(mode)
    with pytest.raises(
        ConfigError, match=rf"everybody .* \(mode {mode:04o}\); `chmod o-w {file}`$"
    ) as refused:
        check_trust(file)
    assert refused.value.path == file
    file.chmod(mode & ~0o002)
    check_trust(file)


@pytest.mark.parametrize("above", [0, 1])
def test_what_everybody_may_replace_is_refused(file: Path, above: int) -> None:
    """The folder that it lies in, or one above, is open to all."""
    folder = file.parents[above]
    folder.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"as {folder} has mode 0777; `chmod o-w {folder}`$"):
        check_trust(file)


def test_in_a_folder_for_everybody_ones_own_are_believed(file: Path) -> None:
    """Such as /tmp, where nobody can rename the files of others."""
    file.parent.chmod(0o1777)
    check_trust(file)
    check_trust(file.rename(file.with_name("renamed.toml")))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_in_a_folder_for_everybody_those_of_strangers_are_refused(file: Path) -> None:
    """Anybody may have put them there before; root's are nobody else's doing."""
    os.chown(file, 12345, -1)
    check_trust(file)  # in a folder of the user's it is the user's business whose they are
    file.parent.chmod(0o1777)
    check_trust(file, user=12345)
    with pytest.raises(ConfigError, match=r"belongs to the user 12345 and lies in .* a folder of yours"):
        check_trust(file, user=54321)
    os.chown(file, 0, -1)
    check_trust(file, user=54321)


def test_a_link_is_believed_if_both_its_place_and_its_file_are(file: Path, tmp_path: Path) -> None:
    """Everybody could have it lead to elsewhere, or change what is there."""
    place = tmp_path / "place"
    place.mkdir()
    link = place / "link.toml"
    link.symlink_to(file)
    check_trust(link)
    place.chmod(0o777)
    with pytest.raises(ConfigError, match=rf"as {place} has mode"):
        check_trust(link)
    place.chmod(0o755)
    file.chmod(0o666)
    with pytest.raises(ConfigError, match=r"link.toml: everybody"):
        check_trust(link)


def test_what_is_not_there_is_not_its_business(tmp_path: Path) -> None:
    """Who reads it says so better; links in a ring and names that cannot be do no harm either."""
    (tmp_path / "ring").symlink_to(tmp_path / "ring")
    for path in (tmp_path / "none", tmp_path / "ring", Path("a\0b")):
        check_trust(path)
