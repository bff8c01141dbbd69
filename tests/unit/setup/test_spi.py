"""SPI in the configuration of the boot loader."""

from __future__ import annotations

import pytest

from tsgt.setup.steps import enable_spi

ON = "dtparam=spi=on"


@pytest.mark.parametrize(
    "text",
    [
        f"{ON}\n",
        f"dtparam=audio=on\n{ON}\n",
        f"[pi4]\narm_boost=1\n[all]\n{ON}\n",
        "dtparam=i2c_arm=on,spi=on\n",
    ],
)
def test_what_is_on_stays_as_it_is(text: str) -> None:
    """Also in the list of one line."""
    assert enable_spi(text) == text


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("dtparam=spi=off\n", f"{ON}\n"),
        ("dtparam=i2c_arm=on,spi=off\n", "dtparam=i2c_arm=on,spi=on\n"),
        ("#dtparam=spi=on", f"#dtparam=spi=on\n# for the radio of tsgt\n{ON}\n"),
        (f"[pi5]\n{ON}\n", f"[pi5]\n{ON}\n\n[all]\n# for the radio of tsgt\n{ON}\n"),
    ],
)
def test_it_is_switched_on_for_every_model(text: str, after: str) -> None:
    """A comment, and a line for another model, are not in force; a second call changes nothing."""
    assert enable_spi(text) == after
    assert enable_spi(after) == after
