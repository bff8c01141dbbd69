"""Link budget and packet error rates: from transmitted power to the probability of reception.

Packet error rates are fitted to the theory of non-coherent detection of orthogonal symbols with the chip's codes
(docs/explanation/simulated-radio.md).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from statistics import NormalDist
from typing import TYPE_CHECKING, Protocol

from tsgt.radio.planning import NOISE_FIGURE_DB, noise_dbm, path_loss_db

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from tsgt.config import ScenarioRadioConfig

# SNR of 50 % packet reception, 64 bytes at rate 4/6; SF6 is extrapolated.
_MEDIAN_SNR_DB = {6: -5.9, 7: -8.7, 8: -11.49, 9: -14.31, 10: -17.16, 11: -19.86, 12: -22.73}
_MEDIAN_BYTES = 64
_SCALE_DB = 0.4
# Halving the length lowers the median SNR and widens the transition by this much.
_MEDIAN_DB_PER_HALVING = 0.4
_SCALE_DB_PER_HALVING = 0.04
# Rates 4/7 and 4/8 correct one wrong symbol in a block, 4/5 and 4/6 only detect it.
_CORRECTION_GAIN_DB = 1.05
_CORRECTION_SCALE = 0.78
# The 20 bits of a header.
_HEADER_BYTES = 2.5
# A preamble is detected at 1 dB less than a payload of five bytes needs.
_DETECTION_GAIN_DB = 2.5

_NORMAL = NormalDist()


def detection_probability(snr_db: float, spreading_factor: int) -> float:
    """Return the probability of preamble detection."""
    return _logistic(snr_db, detection_threshold_db(spreading_factor), _SCALE_DB)


def detection_threshold_db(spreading_factor: int) -> float:
    """Return the SNR at which half of the preambles are detected."""
    return _MEDIAN_SNR_DB[spreading_factor] - _DETECTION_GAIN_DB


def header_probability(snr_db: float, spreading_factor: int) -> float:
    """Return the probability that an explicit header, always coded at rate 4/8, arrives intact."""
    return _block_probability(snr_db, spreading_factor, 8, _HEADER_BYTES)


def payload_probability(snr_db: float, spreading_factor: int, coding_rate: int, payload_bytes: int) -> float:
    """Return the probability that a payload arrives intact, given detection and header; SNR in the signal bandwidth."""
    return _block_probability(snr_db, spreading_factor, coding_rate, payload_bytes)


def _block_probability(snr_db: float, spreading_factor: int, coding_rate: int, length_bytes: float) -> float:
    halvings = math.log2(_MEDIAN_BYTES / max(length_bytes, 1))
    median_db = _MEDIAN_SNR_DB[spreading_factor] - _MEDIAN_DB_PER_HALVING * halvings
    scale_db = _SCALE_DB + _SCALE_DB_PER_HALVING * halvings
    if coding_rate >= 7:
        median_db -= _CORRECTION_GAIN_DB
        scale_db *= _CORRECTION_SCALE
    return _logistic(snr_db, median_db, scale_db)


def _logistic(value: float, median: float, scale: float) -> float:
    return 0.5 + 0.5 * math.tanh((value - median) / (2 * scale))


class PathLoss(Protocol):
    """Path loss between two radios."""

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:
        """Return the loss between antenna connectors, antenna gains deducted."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class FixedLoss:
    """Given path losses, the same in both directions.

    Attributes
    ----------
    pairs_db
        By pair of names, in either order; ``default_db`` for the others.
    """

    default_db: float = 80.0
    pairs_db: Mapping[tuple[str, str], float] = field(default_factory=dict)

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:  # noqa: ARG002 (measured at it)
        """Return the loss of the pair."""
        loss_db = self.pairs_db.get((sender, receiver))
        return loss_db if loss_db is not None else self.pairs_db.get((receiver, sender), self.default_db)


@dataclass(frozen=True, kw_only=True, slots=True)
class LogDistanceLoss:
    """Log-distance path loss with log-normal shadowing; free space with exponent 2 and no shadowing.

    Attributes
    ----------
    positions_m
        Positions by name, in one frame; may be replaced at any time.
    """

    positions_m: Mapping[str, tuple[float, float, float]]
    exponent: float = 2.0  # 2 in free space, 2.7 to 3.5 over ground and through trees
    shadowing_sigma_db: float = 0.0  # one sigma, constant per pair and the same in both directions
    antenna_gain_db: float = 0.0  # of each antenna, cable loss deducted
    seed: int = 0

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:
        """Return the free-space loss at one metre plus the distance term; distances below one metre count as one.

        Raises
        ------
        ValueError
            A radio has no position.
        """
        for name in (sender, receiver):
            if name not in self.positions_m:
                raise ValueError(f"radio {name!r} has no position in the link model")
        distance_m = math.dist(self.positions_m[sender], self.positions_m[receiver])
        shadowing_db = self.shadowing_sigma_db * _shadowing(self.seed, *sorted((sender, receiver)))
        over_distance_db = path_loss_db(distance_m, frequency_hz, self.exponent)
        return over_distance_db + shadowing_db - 2 * self.antenna_gain_db


@lru_cache(maxsize=1024)
def _shadowing(seed: int, one: str, other: str) -> float:
    """Return the shadowing between two radios (names sorted) in units of sigma."""
    return normal_quantile(uniform_draws(seed, "shadowing", f"{one}\0{other}")[0])


@dataclass(kw_only=True, slots=True)
class LinkModel:
    """Path loss, fading and packet loss of the channel."""

    path_loss: PathLoss = field(default_factory=FixedLoss)
    noise_figure_db: float = NOISE_FIGURE_DB  # of every receiver
    rayleigh_fading: bool = False  # whether the power has Rayleigh fading, for moving radios
    loss_probability: float = 0.0  # probability that a receiver misses a frame regardless of its power
    _attenuations_db: dict[frozenset[str], float] = field(default_factory=dict, init=False, repr=False)

    def set_attenuation(self, one: str, other: str, attenuation_db: float) -> None:
        """Set an additional attenuation between two radios, in both directions; 0 removes it."""
        self._attenuations_db[frozenset((one, other))] = attenuation_db

    def loss_db(self, sender: str, receiver: str, frequency_hz: float, draws: Sequence[float]) -> float:
        """Return the path loss of one frame; the second of ``draws``, uniform in (0, 1), is for the fading."""
        loss_db = self.path_loss.loss_db(sender, receiver, frequency_hz)
        if self._attenuations_db:
            loss_db += self._attenuations_db.get(frozenset((sender, receiver)), 0.0)
        if self.rayleigh_fading:
            loss_db -= 10 * math.log10(-math.log(draws[1]))
        return loss_db

    def noise_dbm(self, bandwidth_hz: float) -> float:
        """Return the noise power of a receiver in its bandwidth."""
        return _cached_noise_dbm(bandwidth_hz, self.noise_figure_db)


_cached_noise_dbm = lru_cache(maxsize=64)(noise_dbm)


def scenario_link(
    radio: ScenarioRadioConfig,
    positions_m: Mapping[str, tuple[float, float, float]],
    rng: np.random.Generator,
) -> LinkModel:
    """Return the link model of a scenario.

    Positions are by radio name, in m; the dictionary may be changed while the model is in use.
    """
    return LinkModel(
        path_loss=LogDistanceLoss(
            positions_m=positions_m,
            exponent=radio.path_loss_exponent,
            shadowing_sigma_db=radio.shadowing_sigma_db,
            antenna_gain_db=radio.antenna_gain_db,
            seed=int(rng.integers(2**31)),
        ),
        rayleigh_fading=radio.rayleigh_fading,
        loss_probability=radio.loss_probability,
    )


def uniform_draws(seed: int, *key: str | int) -> tuple[float, ...]:
    """Return seven uniform draws in (0, 1) that depend on seed and key only, on every machine.

    With a shared random stream, each additional radio would change the draws of all others.
    """
    text = "\0".join(map(str, (seed, *key)))
    words = struct.unpack("<7Q", blake2b(text.encode(), digest_size=56).digest())
    return tuple([((word >> 12) + 0.5) * 2.0**-52 for word in words])


def normal_quantile(uniform: float) -> float:
    """Return the quantile of the standard normal distribution."""
    return _NORMAL.inv_cdf(uniform)
