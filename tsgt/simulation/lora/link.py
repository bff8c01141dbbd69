"""From transmitted power to whether a packet is received: link budget and packet error rates.

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

# SNR at which half of the packets of 64 bytes at rate 4/6 get through; SF6 continues the row.
_MEDIAN_SNR_DB = {6: -5.9, 7: -8.7, 8: -11.49, 9: -14.31, 10: -17.16, 11: -19.86, 12: -22.73}
_MEDIAN_BYTES = 64
_SCALE_DB = 0.4
# Half as many bytes get through at so much less SNR, over a range that is so much wider.
_MEDIAN_DB_PER_HALVING = 0.4
_SCALE_DB_PER_HALVING = 0.04
# Rates 4/7 and 4/8 correct one wrong symbol in a block, 4/5 and 4/6 only notice it.
_CORRECTION_GAIN_DB = 1.05
_CORRECTION_SCALE = 0.78
# The 20 bits of a header.
_HEADER_BYTES = 2.5
# A preamble is found at 1 dB less than a payload of five bytes needs.
_DETECTION_GAIN_DB = 2.5

_NORMAL = NormalDist()


def detection_probability(snr_db: float, spreading_factor: int) -> float:
    """Probability that a receiver finds the preamble."""
    return _logistic(snr_db, detection_threshold_db(spreading_factor), _SCALE_DB)


def detection_threshold_db(spreading_factor: int) -> float:
    """SNR at which half of the preambles are found."""
    return _MEDIAN_SNR_DB[spreading_factor] - _DETECTION_GAIN_DB


def header_probability(snr_db: float, spreading_factor: int) -> float:
    """Probability that an explicit header, always sent at rate 4/8, arrives whole."""
    return _block_probability(snr_db, spreading_factor, 8, _HEADER_BYTES)


def payload_probability(snr_db: float, spreading_factor: int, coding_rate: int, payload_bytes: int) -> float:
    """Probability that a payload arrives whole, once its preamble is found and its header has arrived.

    Parameters
    ----------
    snr_db
        Signal to noise ratio in the bandwidth of the signal.
    spreading_factor
        6 to 12.
    coding_rate
        Denominator, 5 to 8.
    payload_bytes
        Its length, 1 to 255.
    """
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
    """What lies between two radios."""

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:
        """Loss from antenna connector to antenna connector, gains of the antennas deducted."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class FixedLoss:
    """Losses as measured or wished for, the same in both directions.

    Attributes
    ----------
    default_db
        Between all pairs that have no loss of their own.
    pairs_db
        By the two names, in either order.
    """

    default_db: float = 80.0
    pairs_db: Mapping[tuple[str, str], float] = field(default_factory=dict)

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:  # noqa: ARG002 (measured at it)
        """Loss of the pair."""
        loss_db = self.pairs_db.get((sender, receiver))
        return loss_db if loss_db is not None else self.pairs_db.get((receiver, sender), self.default_db)


@dataclass(frozen=True, kw_only=True, slots=True)
class LogDistanceLoss:
    """Loss that grows with distance; free space with exponent 2 and no shadowing.

    Attributes
    ----------
    positions_m
        Where each radio stands, by name, in one frame; a moving radio's entry may be replaced at any time.
    exponent
        2 in free space, 2.7 to 3.5 over ground and through trees.
    shadowing_sigma_db
        Spread from link to link, normal in dB; each pair keeps its own value, the same in both directions.
    antenna_gain_db
        Of each of the two antennas, its cable deducted.
    seed
        Of the shadowing.
    """

    positions_m: Mapping[str, tuple[float, float, float]]
    exponent: float = 2.0
    shadowing_sigma_db: float = 0.0
    antenna_gain_db: float = 0.0
    seed: int = 0

    def loss_db(self, sender: str, receiver: str, frequency_hz: float) -> float:
        """Friis to one metre, then the exponent; nearer than one metre counts as one.

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
    """Return the shadowing between two radios, their names in order, in its sigmas."""
    return normal(uniforms(seed, "shadowing", f"{one}\0{other}")[0])


@dataclass(kw_only=True, slots=True)
class LinkModel:
    """What happens to the power of a frame on its way, and what else may keep it from being received.

    Attributes
    ----------
    path_loss
        What lies between the radios.
    noise_figure_db
        Of every receiver.
    fading_sigma_db
        Spread of each frame's power at each receiver, normal in dB: 1 to 3 for radios that stand.
    rayleigh_fading
        Whether the power fades as among many reflections, for radios that move.
    loss_probability
        That a receiver does not hear a frame, whatever its power.
    """

    path_loss: PathLoss = field(default_factory=FixedLoss)
    noise_figure_db: float = NOISE_FIGURE_DB
    fading_sigma_db: float = 0.0
    rayleigh_fading: bool = False
    loss_probability: float = 0.0
    _attenuations_db: dict[frozenset[str], float] = field(default_factory=dict, init=False, repr=False)

    def attenuate(self, one: str, other: str, attenuation_db: float) -> None:
        """Put something between two radios from now on, in both directions; 0 takes it away."""
        self._attenuations_db[frozenset((one, other))] = attenuation_db

    def loss_db(self, sender: str, receiver: str, frequency_hz: float, draws: Sequence[float]) -> float:
        """Loss of one frame on its way, fading included.

        Parameters
        ----------
        sender, receiver
            Their names.
        frequency_hz
            Carrier.
        draws
            Two uniform numbers in (0, 1) for the fading.
        """
        loss_db = self.path_loss.loss_db(sender, receiver, frequency_hz)
        if self._attenuations_db:
            loss_db += self._attenuations_db.get(frozenset((sender, receiver)), 0.0)
        if self.fading_sigma_db:
            loss_db += self.fading_sigma_db * normal(draws[0])
        if self.rayleigh_fading:
            loss_db -= 10 * math.log10(-math.log(draws[1]))
        return loss_db

    def noise_dbm(self, bandwidth_hz: float) -> float:
        """Noise power of a receiver in its bandwidth."""
        return _cached_noise_dbm(bandwidth_hz, self.noise_figure_db)


_cached_noise_dbm = lru_cache(maxsize=64)(noise_dbm)


def uniforms(seed: int, *key: str | int) -> tuple[float, ...]:
    """Seven uniform numbers in (0, 1) that depend on seed and key alone, on every machine.

    A stream of random numbers would give each frame other numbers as soon as one more radio draws from it.
    """
    text = "\0".join(map(str, (seed, *key)))
    words = struct.unpack("<7Q", blake2b(text.encode(), digest_size=56).digest())
    return tuple([((word >> 12) + 0.5) * 2.0**-52 for word in words])


def normal(uniform: float) -> float:
    """Return the standard normal number of that quantile."""
    return _NORMAL.inv_cdf(uniform)
