from __future__ import annotations

import math

import numpy as np
import pytest

from tsgt.radio.planning import REQUIRED_SNR_DB, noise_dbm
from tsgt.simulation.lora import LinkModel, LogDistanceLoss
from tsgt.simulation.lora.link import (
    FixedLoss,
    detection_probability,
    header_probability,
    payload_probability,
    uniform_draws,
)

ERROR_RATES = (0.9, 0.5, 0.1, 0.01)

# SNR in dB for these packet error rates: exact theory of non-coherent detection.
THEORY = {
    (7, 15, 6): (-10.59, -9.57, -8.39, -7.32),
    (7, 34, 6): (-9.90, -9.03, -8.00, -7.02),
    (7, 64, 6): (-9.48, -8.70, -7.74, -6.83),
    (7, 34, 8): (-10.94, -10.24, -9.42, -8.65),
    (8, 15, 6): (-13.24, -12.26, -11.14, -10.11),
    (8, 34, 6): (-12.74, -11.87, -10.85, -9.89),
    (8, 64, 6): (-12.26, -11.49, -10.56, -9.67),
    (8, 34, 8): (-13.68, -12.99, -12.19, -11.43),
    (9, 15, 6): (-16.11, -15.14, -14.01, -12.99),
    (9, 34, 6): (-15.53, -14.68, -13.68, -12.74),
    (9, 64, 6): (-15.06, -14.31, -13.40, -12.53),
    (9, 34, 8): (-16.41, -15.73, -14.95, -14.21),
    (10, 15, 6): (-18.81, -17.87, -16.79, -15.80),
    (10, 34, 6): (-18.36, -17.52, -16.53, -15.61),
    (10, 64, 6): (-17.90, -17.16, -16.26, -15.40),
    (10, 34, 8): (-19.17, -18.50, -17.73, -17.02),
    (11, 15, 6): (-21.53, -20.63, -19.58, -18.63),
    (11, 34, 6): (-21.00, -20.21, -19.27, -18.39),
    (11, 64, 6): (-20.56, -19.86, -19.01, -18.19),
    (11, 34, 8): (-21.81, -21.18, -20.45, -19.77),
    (12, 15, 6): (-24.50, -23.58, -22.52, -21.56),
    (12, 34, 6): (-23.85, -23.07, -22.14, -21.27),
    (12, 64, 6): (-23.43, -22.73, -21.89, -21.08),
    (12, 34, 8): (-24.61, -23.99, -23.27, -22.60),
}


def error_rate(snr_db: float, spreading_factor: int, payload_bytes: int, coding_rate: int) -> float:
    """Return the packet error rate."""
    return 1 - (
        detection_probability(snr_db, spreading_factor)
        * header_probability(snr_db, spreading_factor)
        * payload_probability(snr_db, spreading_factor, coding_rate, payload_bytes)
    )


@pytest.mark.parametrize(("spreading_factor", "payload_bytes", "coding_rate"), THEORY)
def test_packet_error_rates_match_theory(spreading_factor: int, payload_bytes: int, coding_rate: int) -> None:
    """Error rates of 90, 50, 10 and 1 % are at the SNR of the exact theory, to a quarter of a dB."""
    grid_db = np.arange(-30.0, 0.0, 0.01)
    rates = np.array([error_rate(snr, spreading_factor, payload_bytes, coding_rate) for snr in grid_db])
    for expected, snr_db in zip(
        ERROR_RATES, THEORY[spreading_factor, payload_bytes, coding_rate], strict=True
    ):
        assert grid_db[np.argmin(np.abs(rates - expected))] == pytest.approx(snr_db, abs=0.25)


@pytest.mark.parametrize("spreading_factor", range(6, 13))
def test_data_sheet_sensitivity(spreading_factor: int) -> None:
    """At the data sheet's SNR limit at least 90 % of packets of 64 bytes at 4/6 are received."""
    assert error_rate(REQUIRED_SNR_DB[spreading_factor], spreading_factor, 64, 6) < 0.1


@pytest.mark.parametrize("spreading_factor", range(6, 13))
def test_preamble_is_more_robust_than_payload(spreading_factor: int) -> None:
    """Where half of the payloads of 15 bytes are lost, most preambles and headers are received."""
    snr_db = -30.0
    while payload_probability(snr_db, spreading_factor, 6, 15) < 0.5:
        snr_db += 0.01
    assert detection_probability(snr_db, spreading_factor) > 0.95
    assert header_probability(snr_db, spreading_factor) > 0.95


def test_probabilities_stay_in_range_at_extremes() -> None:
    """Extreme SNRs and an empty payload do not overflow."""
    for snr_db in (-1e6, 1e6):
        for probability in (
            detection_probability(snr_db, 12),
            header_probability(snr_db, 12),
            payload_probability(snr_db, 12, 5, 0),
        ):
            assert probability == pytest.approx(float(snr_db > 0))


def test_noise_floor() -> None:
    """A receiver with 6.5 dB has a floor of -113.5 dBm in 250 kHz."""
    assert noise_dbm(250_000, 6.5) == pytest.approx(-113.5, abs=0.05)


@pytest.mark.parametrize(("distance_m", "loss_db"), [(100.0, 71.6), (1000.0, 91.6)])
def test_free_space_loss(distance_m: float, loss_db: float) -> None:
    """At 905 MHz, 100 m cost 71.6 dB and 1 km 91.6 dB."""
    model = LogDistanceLoss(positions_m={"a": (0, 0, 0), "b": (0, distance_m, 0)})
    assert model.loss_db("a", "b", 905e6) == pytest.approx(loss_db, abs=0.05)


def test_exponent_and_antennas() -> None:
    """With exponent 3 each decade of distance costs 30 dB; gain counts at both ends."""
    positions_m = {"a": (0.0, 0.0, 0.0), "b": (10.0, 0.0, 0.0), "c": (100.0, 0.0, 0.0)}
    bare = LogDistanceLoss(positions_m=positions_m, exponent=3.0)
    gained = LogDistanceLoss(positions_m=positions_m, exponent=3.0, antenna_gain_db=2.0)
    assert bare.loss_db("a", "c", 905e6) - bare.loss_db("a", "b", 905e6) == pytest.approx(30.0)
    assert bare.loss_db("a", "b", 905e6) - gained.loss_db("a", "b", 905e6) == pytest.approx(4.0)


def test_radio_without_position_is_rejected() -> None:
    """The error names it."""
    with pytest.raises(ValueError, match="radio 'b' has no position"):
        LogDistanceLoss(positions_m={"a": (0, 0, 0)}).loss_db("a", "b", 905e6)


def test_shadowing_is_constant_per_link() -> None:
    """It is the same in both directions, and has the given spread over links."""
    positions_m = {str(number): (100.0, 0.0, 0.0) for number in range(40)}
    model = LogDistanceLoss(positions_m=positions_m, shadowing_sigma_db=6.0, seed=3)
    plain = LogDistanceLoss(positions_m=positions_m)
    assert model.loss_db("1", "2", 905e6) == model.loss_db("2", "1", 905e6)
    excess_db = [
        model.loss_db(str(a), str(b), 905e6) - plain.loss_db(str(a), str(b), 905e6)
        for a in range(40)
        for b in range(a)
    ]
    assert np.mean(excess_db) == pytest.approx(0.0, abs=0.5)
    assert np.std(excess_db) == pytest.approx(6.0, rel=0.1)


def test_fixed_losses() -> None:
    """A pair has its own loss in both directions, the others the default."""
    model = FixedLoss(default_db=70.0, pairs_db={("a", "b"): 100.0})
    assert [model.loss_db(*pair, 905e6) for pair in (("a", "b"), ("b", "a"), ("a", "c"))] == [100, 100, 70]


def test_attenuation_at_run_time() -> None:
    """An attenuation adds to the loss of a pair until it is removed."""
    link = LinkModel(path_loss=FixedLoss(default_db=70.0))
    link.set_attenuation("a", "b", 25.0)
    assert link.loss_db("b", "a", 905e6, (0.5, 0.5)) == 95.0
    assert link.loss_db("a", "c", 905e6, (0.5, 0.5)) == 70.0
    link.set_attenuation("b", "a", 0.0)
    assert link.loss_db("a", "b", 905e6, (0.5, 0.5)) == 70.0


def test_fading_distribution() -> None:
    """Rayleigh fading keeps the mean power and fades 10 dB in 10 %."""
    draws = [uniform_draws(1, number) for number in range(4000)]
    rayleigh = LinkModel(path_loss=FixedLoss(default_db=0.0), rayleigh_fading=True)
    power = 10 ** (-np.array([rayleigh.loss_db("a", "b", 905e6, pair) for pair in draws]) / 10)
    assert np.mean(power) == pytest.approx(1.0, rel=0.05)
    assert np.mean(power < 0.1) == pytest.approx(1 - math.exp(-0.1), abs=0.015)


def test_uniform_draws_depend_on_their_key_only() -> None:
    """The same key gives the same draws on every machine, another key others; all within (0, 1)."""
    assert uniform_draws(1, "a", 2)[0] == 0.720891533304458
    many = np.array([uniform_draws(seed, "key", number) for seed in range(20) for number in range(100)])
    assert len(np.unique(many)) == many.size
    assert np.all((many > 0) & (many < 1))
    np.testing.assert_allclose(many.mean(axis=0), 0.5, atol=0.03)
    assert np.abs(np.corrcoef(many.T) - np.eye(7)).max() < 0.1
