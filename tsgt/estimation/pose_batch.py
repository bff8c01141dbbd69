"""Poses at many epochs as arrays, with the reasons of invalid ones."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from tsgt.model import ROBOT_ORIGIN, WORLD_FRAME, ReferencePoint
from tsgt.recording import stream_records

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray


class Reason(IntEnum):
    """Why a pose is invalid, in rising order of severity."""

    VALID = 0
    TILT = 1
    RESIDUAL = 2
    DEGENERATE_GEOMETRY = 3
    UNCERTAIN = 4
    OUTAGE = 5
    STATION_STATUS = 6
    CONTRADICTED = 7

    @property
    def word(self) -> stream_records.Reason:
        """The word on the stream; empty for a valid pose."""
        return cast("stream_records.Reason", self.name.lower() if self else "")


class Degradation(IntFlag):
    """What degrades a valid pose."""

    PRISM_MISSING = 1
    OLD_MEASUREMENTS = 2
    UNCERTAIN = 4
    AMBIGUOUS = 8
    RESIDUAL = 16
    IMU_UNCONFIRMED = 32
    IMU_DISAGREES = 64


@functools.cache
def degradation_words(value: int) -> tuple[stream_records.Degradation, ...]:
    """Return the words on the stream of a value of :class:`Degradation`."""
    return tuple(
        cast("stream_records.Degradation", str(each.name).lower()) for each in Degradation if each & value
    )


class ImuUse(IntEnum):
    """Whether a pose rests on the robot's IMU, and why not."""

    NOT_CONFIGURED = 0
    USED = 1
    STARTING = 2
    SILENT = 3
    DISAGREES = 4
    WRONG_SETUP = 5
    UNCONFIRMED = 6

    @property
    def word(self) -> stream_records.ImuUse | None:
        """The word on the stream; None where no IMU is configured."""
        return cast("stream_records.ImuUse", self.name.lower()) if self else None


class Kind(IntEnum):
    """How a pose was computed."""

    INTERPOLATED = 0
    PREDICTED = 1
    SMOOTHED = 2

    @property
    def word(self) -> stream_records.Kind:
        """The word on the stream."""
        return cast("stream_records.Kind", self.name.lower())

    @property
    def estimator(self) -> Literal["linear", "continuous"]:
        """The estimator of such poses."""
        return "linear" if self == Kind.INTERPOLATED else "continuous"


_RECORDS_AT_ONCE = 1024
# Looked up by value: a property of a member takes microseconds
_REASON_WORDS = [reason.word for reason in Reason]
_KIND_WORDS = [kind.word for kind in Kind]
_ESTIMATORS = [kind.estimator for kind in Kind]
_USE_WORDS = [use.word for use in ImuUse]
_VALID = int(Reason.VALID)


@dataclass(frozen=True, slots=True)
class PoseBatch:
    """Poses at N epochs from P prisms, as arrays; NaN where a pose was not computed."""

    stamp_ns: NDArray[np.int64]  # (N,) epochs on the master's Unix clock
    kind: NDArray[np.int8]  # (N,) values of :class:`Kind`
    delay_ns: NDArray[np.int64]  # (N,) delay at which a pose was smoothed before the lag; 0: any other pose
    reason: NDArray[np.int8]  # (N,) values of :class:`Reason`
    degraded: NDArray[np.int8]  # (N,) values of :class:`Degradation` of valid poses; 0: good
    position_m: NDArray[np.float64]  # (N, 3) of the reference point in the frame ``station1``
    orientation_xyzw: NDArray[np.float64]  # (N, 4) of its axes in the frame ``station1``
    covariance: NDArray[np.float64]
    """(N, 6, 6): x, y, z, rotations about the fixed axes x, y, z, in the frame ``station1``, in m and rad."""
    covariance_common: NDArray[np.float64]
    """(N, 6, 6) part of it that all poses share, from the uncertainty of the set-up; NaN where that is unknown."""
    velocity_mps: NDArray[np.float64]  # (N, 3) of the reference point, in ``station1``
    angular_velocity_radps: NDArray[np.float64]  # (N, 3) in the axes of the reference point
    residual_m: NDArray[np.float64]  # (N,) root mean square of the prisms' distances from the fitted layout
    station: NDArray[np.int64]  # (N, P) the station that last measured each prism
    age_s: NDArray[np.float64]  # (N, P) age of that measurement at the epoch; NaN where there was none
    prism_residual_m: NDArray[np.float64]  # (N, P) distance of each prism from the fitted layout
    prism_reason: NDArray[np.int8]  # (N, P) values of :class:`Reason` per prism
    imu: NDArray[np.int8]  # (N,) values of :class:`ImuUse`
    jump: NDArray[
        np.float64
    ]  # (N, 2) in m and rad, by which new measurements moved a prediction; NaN: none did
    prisms: tuple[int, ...]  # numbers of the prisms, the order of the columns
    reference_point: ReferencePoint = ROBOT_ORIGIN  # the frame on the robot whose poses these are

    @classmethod
    def blank(
        cls, stamp_ns: NDArray[np.int64], prisms: tuple[int, ...], kind: Kind = Kind.INTERPOLATED
    ) -> PoseBatch:
        """Return a batch in which nothing is computed and nothing is invalid."""
        n, p = len(stamp_ns), len(prisms)
        return cls(
            stamp_ns=stamp_ns,
            kind=np.full(n, int(kind), np.int8),
            delay_ns=np.zeros(n, np.int64),
            reason=np.zeros(n, np.int8),
            degraded=np.zeros(n, np.int8),
            position_m=np.full((n, 3), np.nan),
            orientation_xyzw=np.full((n, 4), np.nan),
            covariance=np.full((n, 6, 6), np.nan),
            covariance_common=np.full((n, 6, 6), np.nan),
            velocity_mps=np.full((n, 3), np.nan),
            angular_velocity_radps=np.full((n, 3), np.nan),
            residual_m=np.full(n, np.nan),
            station=np.zeros((n, p), np.int64),
            age_s=np.full((n, p), np.nan),
            prism_residual_m=np.full((n, p), np.nan),
            prism_reason=np.zeros((n, p), np.int8),
            imu=np.zeros(n, np.int8),
            jump=np.full((n, 2), np.nan),
            prisms=prisms,
        )

    @classmethod
    def concatenated(cls, batches: Sequence[PoseBatch]) -> PoseBatch:
        """Concatenate at least one batch in the given order."""
        some = [batch for batch in batches if len(batch)]
        if len(some) <= 1:
            return (some or batches)[0]
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(b, name) for b in some]) for name in cls._arrays()
        }
        return replace(some[0], **arrays)

    @classmethod
    def collected(cls, count: int, batches: Iterable[PoseBatch]) -> PoseBatch:
        """Concatenate batches of ``count`` poses in all as they are made: in half the memory. At least one batch."""
        whole: PoseBatch | None = None
        done = 0
        for batch in batches:
            if whole is None:
                arrays: dict[str, Any] = {
                    name: np.empty((count, *getattr(batch, name).shape[1:]), getattr(batch, name).dtype)
                    for name in cls._arrays()
                }
                whole = replace(batch, **arrays)
            for name in cls._arrays():
                getattr(whole, name)[done : done + len(batch)] = getattr(batch, name)
            done += len(batch)
        assert whole is not None and done == count  # noqa: S101, PT018
        return whole

    def select(self, rows: NDArray[np.bool_ | np.intp] | slice) -> PoseBatch:
        """Return the poses of a mask, or of indices in their order."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rows] for name in self._arrays()}
        return replace(self, **arrays)

    @classmethod
    def _arrays(cls) -> list[str]:
        return [name for name in cls.__slots__ if name not in ("prisms", "reference_point")]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) whether a pose may be used."""
        return np.equal(self.reason, int(Reason.VALID))

    def invalid_counts(self) -> dict[str, int]:
        """Return the number of invalid poses by reason, the most frequent first."""
        counts = {reason.word: int(np.count_nonzero(self.reason == reason)) for reason in Reason if reason}
        return {word: n for word, n in sorted(counts.items(), key=lambda item: -item[1]) if n}

    def records(self) -> Iterable[stream_records.PoseRecord]:
        """Yield each pose as a record; numbers that were not computed are None."""
        if len(self) > _RECORDS_AT_ONCE:  # As Python numbers a pose takes five times the memory
            for start in range(0, len(self), _RECORDS_AT_ONCE):
                yield from self.select(slice(start, start + _RECORDS_AT_ONCE)).records()
            return
        if not len(self):
            return
        computed = np.isfinite(self.position_m[:, 0])
        # One conversion to Python numbers per array, not per element.
        rows = zip(
            self.stamp_ns.tolist(),
            self.kind.tolist(),
            self.delay_ns.tolist(),
            self.reason.tolist(),
            self.degraded.tolist(),
            computed.tolist(),
            self.position_m.tolist(),
            self.orientation_xyzw.tolist(),
            self.covariance.reshape(-1, 36).tolist(),
            self.covariance_common.reshape(-1, 36).tolist(),
            self.velocity_mps.tolist(),
            self.angular_velocity_radps.tolist(),
            self.residual_m.tolist(),
            self.imu.tolist(),
            self.jump.tolist(),
            self._shares(),
            strict=True,
        )
        for stamp, kind, delay, reason, degraded, known, *arrays, residual, imu, jump, shares in rows:
            position, orientation, covariance, common, velocity, angular_velocity = (
                tuple(array) if known else None for array in arrays
            )
            if common is not None and math.isnan(common[0]):
                common = None  # the set-up's uncertainty is unknown
            yield stream_records.PoseRecord(
                stamp_ns=stamp,
                frame=WORLD_FRAME,
                child_frame=self.reference_point.name,
                position_m=position,
                orientation_xyzw=orientation,
                covariance=covariance,
                covariance_common=common,
                velocity_mps=velocity,
                angular_velocity_radps=angular_velocity,
                estimator=_ESTIMATORS[kind],
                kind=_KIND_WORDS[kind],
                delay_s=delay / 1e9 if delay else None,
                imu=_USE_WORDS[imu],
                jump_m=None if math.isnan(jump[0]) else jump[0],
                jump_rad=None if math.isnan(jump[0]) else jump[1],
                valid=reason == _VALID,
                reason=_REASON_WORDS[reason],
                quality="invalid" if reason else "degraded" if degraded else "good",
                degraded_by=degradation_words(degraded),
                residual_m=None if math.isnan(residual) else residual,
                stations=shares,
            )

    def _shares(self) -> Iterable[tuple[stream_records.StationShare, ...]]:
        columns = (self.station, self.age_s, self.prism_residual_m, self.prism_reason)
        for stations, ages, residuals, reasons in zip(*(c.tolist() for c in columns), strict=True):
            yield tuple(
                stream_records.StationShare(
                    id=station,
                    prism=prism,
                    age_s=None if math.isnan(age) else age,
                    residual_m=None if math.isnan(residual) else residual,
                    reason=_REASON_WORDS[reason],
                )
                for station, prism, age, residual, reason in zip(
                    stations, self.prisms, ages, residuals, reasons, strict=True
                )
            )
