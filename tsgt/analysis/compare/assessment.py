"""All errors of an estimate under one relation to the reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tsgt.analysis.compare.completeness import Completeness, completeness
from tsgt.analysis.compare.errors import ErrorSeries, JudgedErrors, Nees, absolute, error_series, nees
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.relative import Drift, RelativePoseErrors, drift, relative
from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from tsgt.analysis.compare.pairing import PairedPoses, Pairing
    from tsgt.analysis.compare.relation import Relation
    from tsgt.analysis.evaluation import Bins

MIN_POSES = 2


@dataclass(frozen=True, slots=True)
class Assessment:
    """Errors of an estimate; docs/reference/compare.md defines every figure."""

    pairs: PairedPoses
    series: ErrorSeries
    ate: JudgedErrors
    rpe: tuple[RelativePoseErrors, ...]
    drift: Drift
    completeness: Completeness
    nees: Nees | None

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "ate": self.ate.keys(),
            "rpe": [each.keys() for each in self.rpe],
            "drift": self.drift.keys(),
            "components": self.series.component_keys(),
            "by_motion_mm": {
                "speed_mps": _bins(self.series.by_speed()),
                "turn_rate_radps": _bins(self.series.by_turn_rate()),
            },
            "completeness": self.completeness.keys(),
            "nees": None if self.nees is None else self.nees.keys(),
        }


def _bins(found: Bins | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "edges": found.edges.tolist(),
        "counts": found.counts.tolist(),
        **{name: (1e3 * getattr(found, name)).tolist() for name in ("median", "mean", "p95")},
    }


def paired(pairing: Pairing, relation: Relation) -> PairedPoses:
    """Pair under a relation. Raises GeometryError if fewer than two poses have a reference."""
    pairs = pairing.under(relation)
    if len(pairs.row) < MIN_POSES:
        raise GeometryError(
            f"of {pairs.n_estimate} poses {len(pairs.row)} can be compared: {pairs.n_outside} are before or after the reference, "
            f"{pairs.n_reference_gap} where it is invalid, {pairs.n_reference_weak} where it is weak"
        )
    return pairs


def assess(
    pairing: Pairing, relation: Relation, *, aligned: bool, fair: Relation | None = None
) -> Assessment:
    """Compute all errors of an estimate.

    Parameters
    ----------
    relation
        The relation between estimate and reference: fitted, or known.
    aligned
        Whether the relation's frame was found from these poses: the part of the reference's uncertainty that all poses share
        then does not show in the errors.
    fair
        Relation under which jumps and divergence are found, if another: without the extrinsic, every turn is a jump.

    Raises
    ------
    GeometryError
        Fewer than two poses have a reference.
    """
    pairs = paired(pairing, relation)
    series = error_series(pairs)
    fair_pairs, fair_series = pairs, series
    if fair is not None and fair is not relation:
        fair_pairs = paired(pairing, fair)
        fair_series = error_series(fair_pairs)
    stamp_ns = on_reference_clock(pairing.estimate, relation if fair is None else fair)
    return Assessment(
        pairs=pairs,
        series=series,
        ate=absolute(pairs, aligned=aligned),
        rpe=relative(pairs),
        drift=drift(pairs),
        completeness=completeness(pairing.reference, stamp_ns, fair_pairs, fair_series),
        nees=nees(pairs),
    )
