from __future__ import annotations

import pytest
from harness.radio.air import modulation

from tsgt.simulation.lora.interference import is_above_interference, required_sir_db


def test_co_channel_interferer_requires_the_capture_threshold() -> None:
    """Against the same modulation 6 dB are required, also with a small frequency offset."""
    assert required_sir_db(modulation(), modulation()) == 6.0
    assert required_sir_db(modulation(), modulation(frequency_hz=905.06e6)) == 6.0


@pytest.mark.parametrize(
    ("wanted", "interferer", "ratio_db"), [(7, 8, -8), (8, 7, -11), (9, 12, -15), (12, 7, -25), (12, 11, -23)]
)
def test_spreading_factors_are_nearly_orthogonal(wanted: int, interferer: int, ratio_db: float) -> None:
    """Between spreading factors the table of Croce et al. applies: wanted by row, interferer by column."""
    pair = (modulation(spreading_factor=wanted), modulation(spreading_factor=interferer))
    assert required_sir_db(*pair) == ratio_db


@pytest.mark.parametrize(
    "changes",
    [{"inverted_iq": True}, {"bandwidth_hz": 125_000}, {"frequency_hz": 905.1e6}, {"spreading_factor": 6}],
    ids=str,
)
def test_other_modulations_act_as_noise(changes: dict[str, float]) -> None:
    """An interferer with other chirps acts as noise of its power: -12.5 dB at SF9."""
    assert required_sir_db(modulation(), modulation(**changes)) == -12.5


def test_disjoint_spectra_do_not_interfere() -> None:
    """Signals whose bands do not overlap have no required ratio."""
    assert required_sir_db(modulation(), modulation(frequency_hz=905.25e6)) is None


def test_interferers_add_up_only_while_they_overlap() -> None:
    """Two interferers that are harmless one after the other are too strong together."""
    assert is_above_interference(1.0, [(0.6, 0, 10), (0.6, 10, 20)], from_ns=5)
    assert not is_above_interference(1.0, [(0.6, 0, 11), (0.6, 10, 20)], from_ns=5)


def test_exact_ratio_suffices() -> None:
    """Rounding does not matter."""
    assert is_above_interference(10 ** (-80 / 10), [(10 ** (-86 / 10) * 10 ** (6 / 10), 0, 10)], from_ns=0)
