"""The reference of configuration keys says what a key takes and which tables may be missing."""

from __future__ import annotations

import pytest

from tsgt.config import reference

ROWS = {line.split(" | ")[0]: line for line in reference.markdown().splitlines() if line.startswith("| `")}


@pytest.mark.parametrize(
    ("key", "sentence"),
    [
        ("region", 'One of `"EU433"`, `"EU868"`, `"US915"`, `"CA915"`. |'),
        ("bandwidth_khz", "Above 0, at most 500. |"),
        ("latitude_deg", "-90 to 90. |"),
        ("smoothed_delays_s", "At most 4. |"),
    ],
)
def test_words_and_ranges_are_stated(key: str, sentence: str) -> None:
    """From the models, so that they are right."""
    assert ROWS[f"| `{key}`"].endswith(sentence)


def test_range_is_stated_once() -> None:
    """A description may have it, with more to say about it."""
    assert ROWS["| `spreading_factor`"].count(" 12") == 1


@pytest.mark.parametrize("title", ["`[alarms]`, may be left out: ", "`[radio]`, required, with `kind = "])
def test_tables_that_may_be_missing_are_named(title: str) -> None:
    """A key that is required is so if there is its table."""
    assert f"\n{title}" in reference.markdown()
