"""Poses at many epochs as arrays, and why some of them are not valid."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.model import ROBOT_FRAME, WORLD_FRAME
from tsgt.recording import stream_records

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray


class Reason(IntEnum):
    """Why a pose is not valid; the worst comes last."""

    VALID = 0
    TILT = 1
    RESIDUAL = 2
    DEGENERATE_GEOMETRY = 3
    UNCERTAIN = 4
    OUTAGE = 5
    STATION_STATUS = 6

    @property
    def word(self) -> stream_records.Reason:
        """The word on the stream, empty for a valid pose."""
        return _WORD[self]


_WORD: tuple[stream_records.Reason, ...] = (
    "",
    "tilt",
    "residual",
    "degenerate_geometry",
    "uncertain",
    "outage",
    "station_status",
)


class Kind(IntEnum):
    """How a pose came about, and so which estimator made it."""

    INTERPOLATED = 0
    PREDICTED = 1
    SMOOTHED = 2

    @property
    def word(self) -> stream_records.Kind:
        """The word on the stream."""
        return _KIND_WORD[self]

    @property
    def estimator(self) -> Literal["linear", "continuous"]:
        """Name of the estimator that makes such poses."""
        return "linear" if self == Kind.INTERPOLATED else "continuous"


_KIND_WORD: tuple[stream_records.Kind, ...] = ("interpolated", "predicted", "smoothed")


@dataclass(frozen=True, slots=True)
class PoseBatch:
    """Poses at N epochs from P prisms, as arrays; NaN where a pose could not be computed.

    Attributes
    ----------
    stamp_ns
        (N,) epochs on the master's Unix clock.
    kind
        (N,) values of :class:`Kind`.
    reason
        (N,) values of :class:`Reason`.
    position_m, orientation_xyzw
        (N, 3) and (N, 4): the robot's frame in the frame ``station1``.
    covariance
        (N, 6, 6): x, y, z, rotations about the fixed axes x, y, z, in the frame ``station1``, in m and rad.
    velocity_mps, angular_velocity_radps
        (N, 3) each: of the robot's origin in ``station1``, and in the robot's frame.
    residual_m
        (N,) root mean square, over the prisms, of what they miss the layout by.
    station
        (N, P) the station that last measured each prism.
    age_s
        (N, P) how old that measurement was at the epoch; NaN where there was none.
    prism_residual_m
        (N, P) what each prism misses the layout by.
    prism_reason
        (N, P) values of :class:`Reason` for each prism alone.
    prisms
        Numbers of the prisms, the order of the columns.
    """

    stamp_ns: NDArray[np.int64]
    kind: NDArray[np.int8]
    reason: NDArray[np.int8]
    position_m: NDArray[np.float64]
    orientation_xyzw: NDArray[np.float64]
    covariance: NDArray[np.float64]
    velocity_mps: NDArray[np.float64]
    angular_velocity_radps: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    station: NDArray[np.int64]
    age_s: NDArray[np.float64]
    prism_residual_m: NDArray[np.float64]
    prism_reason: NDArray[np.int8]
    prisms: tuple[int, ...]

    @classmethod
    def blank(
        cls, stamp_ns: NDArray[np.int64], prisms: tuple[int, ...], kind: Kind = Kind.INTERPOLATED
    ) -> PoseBatch:
        """Make a batch in which nothing is computed and nothing is invalid yet."""
        n, p = len(stamp_ns), len(prisms)
        return cls(
            stamp_ns=stamp_ns,
            kind=np.full(n, int(kind), np.int8),
            reason=np.zeros(n, np.int8),
            position_m=np.full((n, 3), np.nan),
            orientation_xyzw=np.full((n, 4), np.nan),
            covariance=np.full((n, 6, 6), np.nan),
            velocity_mps=np.full((n, 3), np.nan),
            angular_velocity_radps=np.full((n, 3), np.nan),
            residual_m=np.full(n, np.nan),
            station=np.zeros((n, p), np.int64),
            age_s=np.full((n, p), np.nan),
            prism_residual_m=np.full((n, p), np.nan),
            prism_reason=np.zeros((n, p), np.int8),
            prisms=prisms,
        )

    @classmethod
    def concatenated(cls, batches: Sequence[PoseBatch]) -> PoseBatch:
        """Join batches in the order given; at least one."""
        some = [batch for batch in batches if len(batch)]
        if len(some) <= 1:
            return (some or batches)[0]
        arrays = {f.name: np.concatenate([getattr(b, f.name) for b in some]) for f in fields(cls)[:-1]}
        return cls(**arrays, prisms=batches[0].prisms)

    def select(self, rows: NDArray[np.bool_]) -> PoseBatch:
        """Return some of them."""
        return PoseBatch(
            **{f.name: getattr(self, f.name)[rows] for f in fields(self)[:-1]}, prisms=self.prisms
        )

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) whether a pose may be used."""
        return np.equal(self.reason, int(Reason.VALID))

    def invalid_counts(self) -> dict[str, int]:
        """Count the poses that are not valid, by the word of their reason, the commonest first."""
        counts = {reason.word: int(np.count_nonzero(self.reason == reason)) for reason in Reason if reason}
        return {word: n for word, n in sorted(counts.items(), key=lambda item: -item[1]) if n}

    def records(self) -> Iterable[stream_records.PoseRecord]:
        """Yield each pose as it leaves the program; numbers that were not computed are None."""
        if not len(self):
            return
        computed = np.isfinite(self.position_m[:, 0])
        # One conversion to Python numbers per array, not per element.
        rows = zip(
            self.stamp_ns.tolist(),
            self.kind.tolist(),
            self.reason.tolist(),
            computed.tolist(),
            self.position_m.tolist(),
            self.orientation_xyzw.tolist(),
            self.covariance.reshape(-1, 36).tolist(),
            self.velocity_mps.tolist(),
            self.angular_velocity_radps.tolist(),
            self.residual_m.tolist(),
            self._shares(),
            strict=True,
        )
        for (
            stamp,
            kind,
            reason,
            known,
            position,
            orientation,
            covariance,
            velocity,
            turning,
            residual,
            shares,
        ) in rows:
            yield stream_records.PoseRecord(
                stamp_ns=stamp,
                frame=WORLD_FRAME,
                child_frame=ROBOT_FRAME,
                position_m=tuple(position) if known else None,
                orientation_xyzw=tuple(orientation) if known else None,
                covariance=tuple(covariance) if known else None,
                velocity_mps=tuple(velocity) if known else None,
                angular_velocity_radps=tuple(turning) if known else None,
                estimator=Kind(kind).estimator,
                kind=_KIND_WORD[kind],
                valid=reason == Reason.VALID,
                reason=_WORD[reason],
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
                    reason=_WORD[reason],
                )
                for station, prism, age, residual, reason in zip(
                    stations, self.prisms, ages, residuals, reasons, strict=True
                )
            )
