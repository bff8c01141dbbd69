"""Mutations of real files for property tests of their readers: bits, values, lines, cuts, repetitions, splices."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hypothesis import settings
from hypothesis import strategies as st

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_PLAIN_EXAMPLES = 100

ODD_VALUES = (
    b"",
    b"0",
    b"-1",
    b"-0.0",
    b"1",
    b"3",
    b"17",
    b"65536",
    b"1e-320",
    b"1.5e300",
    b"-1e300",
    b"1e999",
    b"9223372036854775807",
    b"9223372036854775808",
    b"-9223372036854775809",
    b"9" * 400,
    b"9" * 5000,
    b"0." + b"3" * 5000,
    b"NaN",
    b"nan",
    b"inf",
    b"-Infinity",
    b"null",
    b"true",
    b'""',
    b'"\\u0000"',
    b'"\\u001b[2J\\nred"',
    b'"\\ud800"',
    b'"' + b"x" * 3000 + b'"',
    "\N{ARABIC-INDIC DIGIT THREE}".encode(),
    b"\xff\xfe",
    b"[]",
    b"[1,2,3]",
    b"{}",
    b"[" * 3000,
    b'{"a":' * 3000,
    b"#",
    b"=",
    b",",
    b"\x00",
    b"\x1b[2J",
    b"\r",
    b"\n",
)
"""Replacements for a number, a word or a text."""

_VALUE = re.compile(rb'-?\d[\d.eE+-]*|"[^"\n]*"|[A-Za-z_]\w*')

_BYTES = ("flip", "cut", "drop", "insert", "repeat", "splice")
_LINES = ("line dropped", "line repeated", "lines swapped", "line of another")


def examples(count: int) -> settings:
    """Return settings for this many examples, scaled as the current profile scales the default."""
    return settings(max_examples=max(1, count * settings().max_examples // _PLAIN_EXAMPLES))


class Samples:
    """Real files by name, with a short repr for hypothesis."""

    def __init__(self, of: Mapping[str, bytes]) -> None:
        self.of = of

    def __repr__(self) -> str:
        return f"Samples({', '.join(self.of)})"

    @property
    def all(self) -> list[bytes]:
        """Contents of the files."""
        return list(self.of.values())


@dataclass(frozen=True)
class Edit:
    """A mutation; the meaning of its numbers depends on its kind and on the data."""

    kind: str
    first: int
    second: int
    length: int
    value: bytes
    factor: float


@dataclass(frozen=True)
class Damage:
    """Mutations of one of several samples."""

    sample: int
    edits: tuple[Edit, ...]

    def to(self, samples: Sequence[bytes]) -> bytes:
        """Return one of the samples, mutated."""
        data = samples[self.sample % len(samples)]
        for edit in self.edits:
            if edit.kind in ("value", "nudge"):
                data = _with_value(data, edit)
            elif edit.kind in _LINES:
                data = _with_lines(data, edit, samples)
            else:
                data = _with_bytes(data, edit, samples)
        return data


UNDAMAGED = Damage(0, ())
"""The first sample, unchanged."""

_numbers = st.integers(0, 1 << 20)
_edits = st.builds(
    Edit,
    kind=st.sampled_from([*["value"] * 6, "nudge", "nudge", *_BYTES, *_LINES]),
    # The first lines as often as all others, because the others depend on them.
    first=st.integers(0, 2) | _numbers,
    second=_numbers,
    length=st.integers(1, 200),
    value=st.integers(0, len(ODD_VALUES) - 1).map(ODD_VALUES.__getitem__) | st.binary(max_size=20),
    factor=st.sampled_from([0.0, -1.0, 1.0 + 1e-9, 1.001, 1e9, -1e-9]) | st.floats(-10, 10),
)
damages = st.builds(Damage, _numbers, st.lists(_edits, max_size=4).map(tuple))
"""Zero to four mutations."""


def _with_value(data: bytes, edit: Edit) -> bytes:
    """Replace a value in a line."""
    lines = data.split(b"\n")
    at = edit.first % len(lines)
    values = list(_VALUE.finditer(lines[at]))
    if not values:
        return data
    start, end = values[edit.second % len(values)].span()
    new = edit.value if edit.kind == "value" else _scaled(lines[at][start:end], edit)
    lines[at] = lines[at][:start] + new + lines[at][end:]
    return b"\n".join(lines)


def _scaled(value: bytes, edit: Edit) -> bytes:
    """Scale a number; leave a word unchanged."""
    if value.lstrip(b"-").isdigit() and len(value) < 25:
        return b"%d" % (int(value) + round(edit.factor * edit.length))
    try:
        return repr(float(value) * edit.factor).encode()
    except ValueError:
        return value


def _with_lines(data: bytes, edit: Edit, samples: Sequence[bytes]) -> bytes:
    lines = data.split(b"\n")
    one, other = edit.first % len(lines), edit.second % len(lines)
    match edit.kind:
        case "line dropped":
            del lines[one]
        case "line repeated":
            lines.insert(other, lines[one])
        case "lines swapped":
            lines[one], lines[other] = lines[other], lines[one]
        case _:
            inserted = samples[edit.length % len(samples)].split(b"\n")
            lines.insert(one, inserted[edit.second % len(inserted)])
    return b"\n".join(lines)


def _with_bytes(data: bytes, edit: Edit, samples: Sequence[bytes]) -> bytes:
    at = edit.second % (len(data) + 1)
    match edit.kind:
        case "flip":
            return data[:at] + bytes(byte ^ (edit.length | 1) for byte in data[at : at + 1]) + data[at + 1 :]
        case "cut":
            return data[:at]
        case "drop":
            return data[:at] + data[at + edit.length :]
        case "insert":
            return data[:at] + edit.value + data[at:]
        case "repeat":
            return data[: at + edit.length] + data[at:]
        case _:
            other = samples[edit.length % len(samples)]
            return data[:at] + other[edit.first % (len(other) + 1) :]
