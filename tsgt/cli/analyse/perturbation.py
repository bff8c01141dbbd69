"""The command ``analyse perturbation``: effect of noise on the prisms on position and rotation."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.design import Perturbation, equivalent_noise, first_order_sigmas, perturbation_study
from tsgt.cli.analyse.options import figure_option, point_text, read_layout
from tsgt.cli.options import FiniteRange, json_option, path_type, point_option, resolved_point
from tsgt.cli.output import print_json, print_table
from tsgt.cli.progress import progress
from tsgt.config import ScenarioConfig, scenario_parameters
from tsgt.model import PrismPosition

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.geometry import FloatArray
    from tsgt.model import ReferencePoint

_EQUIVALENT_SAMPLES = 100_000
"""Enough for three digits of the figures of one noise level."""
_MAX_LEVELS = 10_000
_LISTED_LEVELS = 10

# Section IV-E of the paper, on its mean inter-prism error.
_PAPER = "The paper: 10 mm between prisms are 10 mm in position and 0.01 rad in rotation."


@click.command()
@click.option(
    "--noise-mm-max",
    type=FiniteRange(0, 10_000),
    default=400.0,
    help="Largest noise: one sigma per coordinate of each prism.",
)
@click.option(
    "--step-mm",
    type=FiniteRange(0, 10_000, min_open=True),
    default=4.0,
    help="Step between noise levels, starting at 0.",
)
@click.option(
    "--samples",
    "--draws",
    "samples",
    type=click.IntRange(2, 1_000_000),
    default=1000,
    help="Poses per noise level.",
)
@click.option(
    "--inter-prism-mm",
    type=FiniteRange(0, 10_000, min_open=True),
    default=10.0,
    help="Mean error of the distances between prisms, as from `tsgt evaluate`, to convert to pose errors.",
)
@click.option(
    "--prisms",
    type=path_type,
    help="Prism layout (set-up file).  [default: that of the scenario dynamic, with the paper's distances]",
)
@point_option("centroid")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of the noise.")
@figure_option
@json_option
def perturbation_command(
    *,
    noise_mm_max: float,
    step_mm: float,
    samples: int,
    inter_prism_mm: float,
    prisms: Path | None,
    point: ReferencePoint | str | None,
    seed: int,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Study the effect of prism noise on poses.

    The paper's perturbation study: white noise on every coordinate of every prism, and mean and spread of the pose
    errors along and about each axis, and of their norms. First-order propagation holds for small noise; the study
    shows its limit.
    """
    levels = math.floor(noise_mm_max / step_mm + 1e-9) + 1
    if levels > _MAX_LEVELS:
        raise click.UsageError(
            f"{levels} noise levels, at most {_MAX_LEVELS} are allowed: increase --step-mm"
        )
    parameters = scenario_parameters(ScenarioConfig())
    if prisms is not None:
        wanted = tuple(PrismPosition(prism=p, position_m=place) for p, place in read_layout(prisms).items())
        parameters = dataclasses.replace(parameters, prisms=wanted)
    at = resolved_point("centroid" if point is None else point, parameters)
    known = {prism.prism: prism.position_m for prism in parameters.prisms}
    layout, point_m = np.array(list(known.values())), np.array(at.position_m)
    random = np.random.default_rng(seed)
    with progress("perturbing") as on_progress:
        study = perturbation_study(
            layout,
            [1e-3 * step_mm * level for level in range(levels)],
            samples=samples,
            point_m=point_m,
            random=random,
            on_progress=on_progress,
        )
    as_measured = equivalent_noise(
        layout, inter_prism_mm / 1e3, samples=_EQUIVALENT_SAMPLES, point_m=point_m, random=random
    )
    per_mm = first_order_sigmas(layout, 1e-3, point_m=point_m)
    if figure is not None:
        from tsgt.analysis.figures import draw_perturbation

        draw_perturbation(study, per_mm, at, [figure])
    if as_json:
        print_json(
            {
                "prisms": known,
                "reference_point": dataclasses.asdict(at),
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
    _print_equivalent(as_measured, per_mm, at)


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
    click.echo(f"{len(study)} noise levels, {samples} poses each; mean and standard deviation (mm, mrad)\n")
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
    """Return mean and standard deviation of three axes in thousandths."""
    # The mean is rounded first, to avoid -0.0.
    return [f"{round(1e3 * m, 1) + 0:.1f} ± {1e3 * s:.1f}" for m, s in zip(mean, std, strict=True)]


def _print_equivalent(
    found: Perturbation, per_mm: tuple[FloatArray, FloatArray], point: ReferencePoint
) -> None:
    noise_mm = 1e3 * found.noise_m
    click.echo(
        f"\nA mean error of {1e3 * found.inter_prism_mean_m:g} mm between prisms corresponds to noise of {noise_mm:.2f} mm "
        "per coordinate. Pose errors with this noise:\n"
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
    click.echo(f"\nThe position is that of {point_text(point)}. {_PAPER}")


def _mm(values: FloatArray) -> list[float]:
    """Return thousandths: mm of m, mrad of rad."""
    return [1e3 * float(value) for value in values]
