"""The command ``analyse perturbation``: what noise on the prisms means in position and rotation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.design import Perturbation, equivalent, first_order_sigmas, perturbation_study
from tsgt.cli.analyse.options import figure_option, read_layout
from tsgt.cli.options import finite, json_option, path_type
from tsgt.cli.output import print_json, print_table
from tsgt.cli.recordings import progress
from tsgt.config import ScenarioConfig

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.geometry import FloatArray

_EQUIVALENT_DRAWS = 100_000
"""One noise alone can be drawn so often that three digits of its figures hold."""
_MOST_LEVELS = 10_000
_LISTED_LEVELS = 10

# What the paper says that its mean inter-prism error means (section IV-E).
_PAPER = "The paper: 10 mm between prisms are 10 mm in position and 0.01 rad in rotation."


@click.command()
@click.option(
    "--noise-mm-max",
    type=click.FloatRange(0, 10_000),
    callback=finite,
    default=400.0,
    show_default=True,
    help="Largest noise: one sigma per coordinate of each prism.",
)
@click.option(
    "--step-mm",
    type=click.FloatRange(0, 10_000, min_open=True),
    callback=finite,
    default=4.0,
    show_default=True,
    help="From 0 in steps of this.",
)
@click.option(
    "--samples",
    "--draws",
    "samples",
    type=click.IntRange(2, 1_000_000),
    default=1000,
    show_default=True,
    help="Poses for each noise.",
)
@click.option(
    "--inter-prism-mm",
    type=click.FloatRange(0, 10_000, min_open=True),
    callback=finite,
    default=10.0,
    show_default=True,
    help="Mean error of the distances between prisms, as `tsgt evaluate` finds it: what does it mean for poses?",
)
@click.option(
    "--prisms",
    type=path_type,
    help="Prism layout (set-up file).  [default: that of the scenario dynamic, with the paper's distances]",
)
@click.option(
    "--point",
    "point_m",
    type=(float, float, float),
    metavar="X Y Z",
    help="Point of the robot whose position counts, in its frame, in m.  [default: the prisms' centroid]",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the noise.")
@figure_option
@json_option
def perturbation_command(
    *,
    noise_mm_max: float,
    step_mm: float,
    samples: int,
    inter_prism_mm: float,
    prisms: Path | None,
    point_m: tuple[float, float, float] | None,
    seed: int,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Put noise on the prisms and see what becomes of the pose: the paper's perturbation study.

    White noise on every coordinate of every prism, from nothing to far beyond what measurements have; mean and
    spread of the errors along and about each axis, and of their lengths. Small noise does what a propagation of first
    order says; the study shows where that ends.
    """
    levels = math.floor(noise_mm_max / step_mm + 1e-9) + 1
    if levels > _MOST_LEVELS:
        raise click.UsageError(f"{levels} sizes of noise are too many: enlarge --step-mm")
    if point_m is not None and not np.isfinite(point_m).all():
        raise click.UsageError("--point needs finite numbers")
    known = _default_layout() if prisms is None else read_layout(prisms)
    layout = np.array(list(known.values()))
    point = layout.mean(axis=0) if point_m is None else np.array(point_m)
    random = np.random.default_rng(seed)
    with progress("perturbing") as on_progress:
        study = perturbation_study(
            layout,
            [1e-3 * step_mm * level for level in range(levels)],
            draws=samples,
            point_m=point,
            random=random,
            on_progress=on_progress,
        )
    as_measured = equivalent(
        layout, inter_prism_mm / 1e3, draws=_EQUIVALENT_DRAWS, point_m=point, random=random
    )
    per_mm = first_order_sigmas(layout, 1e-3, point_m=point)
    if figure is not None:
        from tsgt.analysis.figures import draw_perturbation

        draw_perturbation(study, per_mm, [figure])
    if as_json:
        print_json(
            {
                "prisms": known,
                "point_m": point.tolist(),
                "samples": samples,
                "seed": seed,
                "at_mm": {f"{1e3 * each.noise_m:g}": _keys(each) for each in study},
                "first_order_per_mm": {
                    "position_std_mm": _mm(per_mm[0]),
                    "euler_std_rad": per_mm[1].tolist(),
                },
                "equivalent": {"noise_mm": 1e3 * as_measured.noise_m, **_keys(as_measured)},
            }
        )
        return
    _print(study, samples)
    _print_equivalent(as_measured, per_mm, point)


def _default_layout() -> dict[int, tuple[float, float, float]]:
    return {prism.prism: prism.position_m for prism in ScenarioConfig().prisms}


def _keys(found: Perturbation) -> dict[str, Any]:
    return {
        "inter_prism_mean_mm": 1e3 * found.inter_prism_mean_m,
        "inter_prism_std_mm": 1e3 * found.inter_prism_std_m,
        "position_norm_mean_mm": 1e3 * found.position_norm_mean_m,
        "position_norm_std_mm": 1e3 * found.position_norm_std_m,
        "rotation_norm_mean_rad": found.rotation_norm_mean_rad,
        "rotation_norm_std_rad": found.rotation_norm_std_rad,
        "position_mean_mm": _mm(found.position_mean_m),
        "position_std_mm": _mm(found.position_std_m),
        "position_abs_mean_mm": _mm(found.position_abs_mean_m),
        "euler_mean_rad": found.euler_mean_rad.tolist(),
        "euler_std_rad": found.euler_std_rad.tolist(),
        "euler_abs_mean_rad": found.euler_abs_mean_rad.tolist(),
    }


def _print(study: Sequence[Perturbation], samples: int) -> None:
    click.echo(f"{len(study)} sizes of noise, {samples} poses each; mean and standard deviation (mm, mrad)\n")
    stride = max(1, (len(study) - 1) // _LISTED_LEVELS)
    rows = [
        [
            f"{1e3 * each.noise_m:g}",
            f"{1e3 * each.inter_prism_mean_m:.1f}",
            f"{1e3 * each.position_norm_mean_m:.1f}",
            *_spreads(each.position_mean_m, each.position_std_m),
            f"{1e3 * each.rotation_norm_mean_rad:.1f}",
            *_spreads(each.euler_mean_rad, each.euler_std_rad),
        ]
        for each in study[::stride]
    ]
    print_table(["noise", "distance", "position", *"xyz", "rotation", "roll", "pitch", "yaw"], rows)


def _spreads(mean: FloatArray, std: FloatArray) -> list[str]:
    """Mean and standard deviation of three axes, in thousandths."""
    # The mean rounded before it is written, as nothing is to be minus nothing.
    return [f"{round(1e3 * m, 1) + 0:.1f} ± {1e3 * s:.1f}" for m, s in zip(mean, std, strict=True)]


def _print_equivalent(found: Perturbation, per_mm: tuple[FloatArray, FloatArray], point: FloatArray) -> None:
    noise_mm = 1e3 * found.noise_m
    click.echo(
        f"\nA mean error of {1e3 * found.inter_prism_mean_m:g} mm between prisms is noise of {noise_mm:.2f} mm "
        "per coordinate. For the pose it means\n"
    )
    rows = [
        [
            "position (mm)",
            f"{1e3 * found.position_norm_mean_m:.2f}",
            *(f"{value:.2f}" for value in (*_mm(found.position_abs_mean_m), *_mm(found.position_std_m))),
            *(f"{noise_mm * value:.2f}" for value in _mm(per_mm[0])),
        ],
        [
            "rotation (mrad)",
            f"{1e3 * found.rotation_norm_mean_rad:.2f}",
            *(f"{value:.2f}" for value in (*_mm(found.euler_abs_mean_rad), *_mm(found.euler_std_rad))),
            *(f"{noise_mm * value:.2f}" for value in _mm(per_mm[1])),
        ],
    ]
    axes = ("x", "y", "z")
    header = ["", "mean norm", *(f"mean |{a}|" for a in axes), *(f"std {a}" for a in axes)]
    print_table([*header, *(f"1st order {a}" for a in axes)], rows)
    where = ", ".join(f"{round(float(value), 3) + 0:.3f}" for value in point)
    click.echo(f"\nPosition is that of the point ({where}) m of the robot. {_PAPER}")


def _mm(values: FloatArray) -> list[float]:
    """Thousandths: mm of m, mrad of rad."""
    return [1e3 * float(value) for value in values]
