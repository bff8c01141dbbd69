from __future__ import annotations

from dataclasses import asdict

import pytest
from harness.hardware.radios import PAPER

from tsgt.errors import RadioSettingsError
from tsgt.radio import LoRaSettings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frequency_hz", 136_999_999),
        ("frequency_hz", 1_020_000_001),
        ("spreading_factor", 6),
        ("spreading_factor", 13),
        ("bandwidth_hz", 200_000),
        ("coding_rate", 4),
        ("coding_rate", 9),
        ("preamble_symbols", 5),
        ("preamble_symbols", 65_536),
        ("sync_word", -1),
        ("sync_word", 256),
        ("power_dbm", 1),
        ("power_dbm", 18),
        ("power_dbm", 21),
    ],
)
def test_setting_out_of_range_is_rejected(name: str, value: int) -> None:
    """A setting that the chip does not support is rejected with its name and value."""
    with pytest.raises(RadioSettingsError, match=rf"{name} must be .*, got {value}"):
        LoRaSettings(**{**asdict(PAPER), name: value})


def test_settings_error_is_a_value_error() -> None:
    """Pydantic and argparse, which catch ValueError, show the message."""
    assert issubclass(RadioSettingsError, ValueError)
