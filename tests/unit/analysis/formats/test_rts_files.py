from __future__ import annotations

from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import LAYOUT
from harness.files.authors_files import write_prisms

from tsgt.analysis.formats import read_prisms
from tsgt.analysis.formats.rts_files import read_track
from tsgt.errors import ConfigError, InputFileError

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1647269269.6711357", 1_647_269_269_671_135_700),
        ("1647269269", 1_647_269_269_000_000_000),
        ("1647269269.123456789", 1_647_269_269_123_456_789),
        ("1.6472692696711357e9", 1_647_269_269_671_135_700),
        ("0.0000000004", 0),
    ],
)
def test_times_are_read_to_the_nanosecond(tmp_path: Path, text: str, stamp_ns: int) -> None:
    """The decimal text is the time, without a float's rounding."""
    path = tmp_path / "track.csv"
    path.write_text(f"{text} 1 2 3\n", encoding="utf-8")
    assert read_track(path).stamps_ns.tolist() == [stamp_ns]


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    """As editors of Windows write it."""
    path = tmp_path / "track.csv"
    path.write_text("1.0 1 2 3\n", encoding="utf-8-sig")
    assert read_track(path).stamps_ns.tolist() == [1_000_000_000]


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "1e40", "1_0:0"])
def test_invalid_time_is_rejected(tmp_path: Path, text: str) -> None:
    """The message quotes the text of the file."""
    path = tmp_path / "track.csv"
    path.write_text(f"{text} 1 2 3\n", encoding="utf-8")
    with pytest.raises(InputFileError, match=f"line 1: expected a Unix time in s, got '{text}'"):
        read_track(path)


def test_blank_lines_are_counted_in_line_numbers(tmp_path: Path) -> None:
    """The line number in a message is that of an editor."""
    path = tmp_path / "track.csv"
    path.write_text("\n1.0 1 2 3\n\n0.5 1 2 3\n", encoding="utf-8")
    with pytest.raises(InputFileError, match=r"line 4: time decreases: 0\.5 is 0\.500 s before") as error:
        read_track(path)
    assert (error.value.path, error.value.line) == (path, 4)


def test_prisms_are_the_first_three_rows(tmp_path: Path) -> None:
    """Further rows contain other sensors."""
    path = write_prisms(tmp_path, np.vstack([LAYOUT, [[9.0, 9.0, 9.0]]]))
    prisms = read_prisms(path)
    assert [prism.prism for prism in prisms] == [1, 2, 3]
    np.testing.assert_array_equal([prism.position_m for prism in prisms], LAYOUT)


def test_prisms_are_read_from_a_set_up_file(tmp_path: Path) -> None:
    """The suffix .toml distinguishes our own format from the authors'."""
    path = tmp_path / "prisms.toml"
    tables = [f"[prisms.{k}]\nposition_m = {row.tolist()}" for k, row in enumerate(LAYOUT, start=1)]
    path.write_text("\n".join(['kind = "prism_layout"', *tables]), encoding="utf-8")
    np.testing.assert_array_equal([prism.position_m for prism in read_prisms(path)], LAYOUT)


def test_invalid_set_up_file_is_a_configuration_error(tmp_path: Path) -> None:
    """It is not read as the authors' format instead."""
    path = tmp_path / "prisms.toml"
    path.write_text("1 2 3 1\n" * 3, encoding="utf-8")
    with pytest.raises(ConfigError, match="not TOML"):
        read_prisms(path)


def test_field_tracks_are_read_exactly(field_data: Path) -> None:
    """All lines of the six field tracks, to the last digit of their times."""
    for path in sorted(field_data.glob("20220314/**/trimble?.csv")):
        track = read_track(path)
        texts = [line.split()[0] for line in path.read_text(encoding="utf-8").splitlines()]
        assert [Decimal(stamp) / 10**9 for stamp in track.stamps_ns.tolist()] == list(map(Decimal, texts))
        np.testing.assert_array_equal(track.points_m, np.loadtxt(path)[:, 1:])
