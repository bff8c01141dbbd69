"""Calibration from targets: whether causes are named, and the covariance of the frames is honest.

Simulated campaigns: three stations within 8 m, 8 to 14 targets at 10 to 150 m, one face; the errors of one kind each, all
other instrument errors drawn from the data sheet. A cause is named if a note names it: a rejected sight, an instrument error that surely exceeds
three sigmas of the data sheet, a tripod that moved, noise larger than stated. NEES is that of all frames together, over its degrees of freedom.
A second table: what the note on a rejected target says, where it moved between the rounds or a station erred.

    python benchmarks/run.py target_calibration [SEEDS] [rejected]
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from harness.instruments.target_field import TargetField, frame_nees
from scipy.special import chdtri

from tsgt.analysis.calibration import TargetCalibration, target_notes
from tsgt.geometry.target_calibration import (
    DATA_SHEET_SIGMA,
    CauseKind,
    InstrumentError,
    NetworkCalibration,
    calibrate_network,
    checks,
)
from tsgt.model import TARGET_NOISE, SetupCovariance

if TYPE_CHECKING:
    from collections.abc import Callable

SEEDS = 40
NOISE_LEVEL = 1e-3
INDEX, COLLIMATION, SCALE, CONSTANT = InstrumentError
Cause = tuple[str, ...]

VERDICTS = ("exactly", "and more", "in part", "another", "nothing")


def main() -> None:
    """Print one row per kind of error, and one per fate of a rejected target."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS
    if sys.argv[2:] != ["rejected"]:
        print_causes(seeds)
        print()
    print_rejected(seeds)


def print_causes(seeds: int) -> None:
    """Print what is named, and how good the frames are."""
    header = ["error", *VERDICTS, "exit code 3", "frames within 95 %", "NEES"]
    print(f"| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for name, (changes, truth) in kinds().items():
        verdicts, failed, inside, nees = Counter[str](), 0, 0, list[float]()
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            options: dict[str, Any] = {
                "targets": int(rng.integers(8, 15)),
                "in_specification": True,
                **changes(rng),
            }
            field = TargetField(rng=rng, **options)
            solved = calibrate_network(field.measure(), TARGET_NOISE)
            verdicts[verdict(named(solved), truth)] += 1
            failed += not all(check.ok for check in checks(solved))
            squared, freedom = frame_nees(solved, field)
            nees.append(squared / freedom)
            inside += int(squared < chdtri(freedom, 0.05))
        counts = [str(verdicts[each]) for each in VERDICTS]
        print(
            f"| {name} | {' | '.join(counts)} | {failed} | {inside} of {seeds} | {np.mean(nees):.2f} |",
            flush=True,
        )


def print_rejected(seeds: int) -> None:
    """Print what the note on a rejected target says."""
    print("| target 1 | moved | erred | not told | not rejected |\n|---|---|---|---|---|")
    for name, (change, station, size_m) in REJECTED.items():
        counts = Counter(said(change, station, size_m, np.random.default_rng(seed)) for seed in range(seeds))
        print(
            f"| {name} | {counts['moved']} | {counts['erred']} | {counts['not told']} | {counts['']} |",
            flush=True,
        )


REJECTED = {
    "moved by 15 mm after station 1": ("moved", 0, 0.015),
    "moved by 15 mm before station 3": ("moved", 2, 0.015),
    "moved by 50 mm after station 1": ("moved", 0, 0.050),
    "moved by 15 mm horizontally after station 1": ("level", 0, 0.015),
    "moved by 50 mm horizontally before station 3": ("level", 2, 0.050),
    "distance of station 1 wrong by 15 mm": ("along", 0, 0.015),
    "distance of station 1 wrong by 50 mm": ("along", 0, 0.050),
    "horizontal angle of station 3 wrong by 15 mm": ("across", 2, 0.015),
    "horizontal angle of station 3 wrong by 50 mm": ("across", 2, 0.050),
    "vertical angle of station 1 wrong by 50 mm": ("up", 0, 0.050),
    "station 1 aimed 30 mm beside": ("beside", 0, 0.030),
    "station 2 aimed 30 mm beside": ("beside", 1, 0.030),
}
"""What happened to target 1, which station's measurement differs from the two others', and the size in m."""


def said(change: str, station: int, size_m: float, rng: np.random.Generator) -> str:
    """Say what the note on the rejected target names."""
    field = TargetField(rng=rng, targets=int(rng.integers(8, 15)), in_specification=True)
    line = field.points_m[0] - field.translation_m[station]
    along = line / np.linalg.norm(line)
    across = np.array([-line[1], line[0], 0.0]) / np.hypot(line[0], line[1])
    up = np.cross(along, across)
    angle = rng.uniform(0, 2 * np.pi)
    direction = {
        "moved": off(rng) / 0.015,
        "level": np.array([np.cos(angle), np.sin(angle), 0.0]),
        "along": along,
        "across": across,
        "up": up,
        "beside": np.cos(angle) * across + np.sin(angle) * up,
    }[change]
    field.displaced = {(station, 0): size_m * direction}
    network = calibrate_network(field.measure(), TARGET_NOISE)
    solved = TargetCalibration(
        network, {}, SetupCovariance(components=(), matrix=()), applied=True, atmospheric_ppm={}
    )
    notes = [note for note in target_notes(solved) if "target 1 rejected" in note]
    if not notes:
        return ""
    for words, verdict in (
        ("cannot be told", "not told"),
        ("do not tell", "not told"),
        ("the station erred", "erred"),
    ):
        if words in notes[0]:
            return verdict
    return "moved"


def kinds() -> dict[str, tuple[Callable[[np.random.Generator], dict[str, Any]], set[Cause]]]:
    """Return by name the changes of a field, drawn from its generator, and the causes to be named."""

    def far(rng: np.random.Generator, station: int) -> dict[str, Any]:
        return {"far": 2, "displaced": {(station, target): off(rng) for target in (0, 1)}}

    sights: set[Cause] = {("sight", "1", "0"), ("sight", "1", "1")}
    index: set[Cause] = {("instrument", "1", str(INDEX))}
    return {
        "none, ideal instruments": (lambda _: {"in_specification": False}, set()),
        "none, instruments within the data sheet": (lambda _: {}, set()),
        "vertical index 0.2 mrad": (lambda _: {"errors": {(1, INDEX): 2e-4}}, index),
        "vertical index 0.2 mrad, both faces": (
            lambda _: {"errors": {(1, INDEX): 2e-4}, "both_faces": True},
            index,
        ),
        "collimation 0.2 mrad, both faces": (
            lambda _: {"errors": {(1, COLLIMATION): 2e-4}, "both_faces": True},
            {("instrument", "1", str(COLLIMATION))},
        ),
        "scale 50 ppm": (lambda _: {"errors": {(1, SCALE): 5e-5}}, {("instrument", "1", str(SCALE))}),
        "constant 8 mm": (lambda _: {"errors": {(1, CONSTANT): 0.008}}, {("instrument", "1", str(CONSTANT))}),
        "target constant 10 mm": (
            lambda _: {"errors": {(row, CONSTANT): 0.01 for row in range(3)}},
            {("target_constant",)},
        ),
        "one target 15 mm off": (
            lambda rng: {"displaced": {(1, 0): off(rng)}},
            {("sight", "1", "0")},
        ),
        "a target moved after station 1": (
            lambda rng: {"displaced": dict.fromkeys([(1, 0), (2, 0)], off(rng))},
            {("sight", "0", "0")},
        ),
        "two targets at 260 to 290 m 15 mm off": (lambda rng: far(rng, 1), sights),
        "the same at station 1": (
            lambda rng: far(rng, 0),
            {("sight", "0", "0"), ("sight", "0", "1")},
        ),
        "the same and vertical index 0.2 mrad": (
            lambda rng: far(rng, 1) | {"errors": {(1, INDEX): 2e-4}},
            sights | index,
        ),
        "tripod 5 mm and 0.1 mrad in its round": (
            lambda rng: {"moved_tripod": (1, 4, np.array([*(off(rng) / 3), 1e-4]))},
            {("tripod", "1")},
        ),
        "noise 2 times": (lambda _: {"noise": 2.0}, {("noise",)}),
        "noise 2 times and vertical index 0.2 mrad": (
            lambda _: {"noise": 2.0, "errors": {(1, INDEX): 2e-4}},
            index | {("noise",)},
        ),
    }


def off(rng: np.random.Generator) -> np.ndarray:
    """Draw a displacement of 15 mm in any direction."""
    direction = rng.normal(size=3)
    return np.asarray(0.015 * direction / np.linalg.norm(direction))


def named(solved: NetworkCalibration) -> list[set[Cause]]:
    """Return the named causes; each a set of alternatives that the note names together."""
    found: list[set[Cause]] = []
    for cause in solved.causes:
        labels = [
            (str(each.kind), *(() if each.kind is CauseKind.TARGET_CONSTANT else (str(each.station),)))
            + (
                (str(each.target),)
                if each.kind is CauseKind.SIGHT
                else (str(each.error),)
                if each.kind is CauseKind.INSTRUMENT
                else ()
            )
            for each in (cause, *(o for o in cause.alternatives if o.kind is cause.kind))
        ]
        if cause.kind is CauseKind.INSTRUMENT and cause.error is not None:
            estimate = solved.errors[cause.station, cause.error]
            if abs(estimate.value) - 1.5 * estimate.sigma < 3 * DATA_SHEET_SIGMA[cause.error]:
                continue
        found.append(set(labels))
    has_moved = any(cause.kind is CauseKind.TRIPOD for cause in solved.causes)
    if solved.overall.p_value < NOISE_LEVEL and not has_moved:
        found.append({("noise",)})
    return found


def verdict(found: list[set[Cause]], truth: set[Cause]) -> str:
    """Compare the named causes with the true ones."""
    right = {cause for cause in truth if any(cause in each for each in found)}
    more = [each for each in found if not each & truth]
    if not found:
        return "nothing" if truth else "exactly"
    if right == truth:
        return "and more" if more else "exactly"
    return "in part" if right else "another"


if __name__ == "__main__":
    main()
