"""Throughput of aligning prism triplets: closed form, batched SVD, and a loop over triplets.

All three align the same 200,000 noisy triplets and must agree. The loop sees a part of them; its time is scaled up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from measuring import best_s
from scipy.spatial.transform import Rotation

from tsgt.geometry import align_many, align_triplets

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

TRIPLETS = 200_000
LOOP_TRIPLETS = 20_000
ROUNDS = 7
NOISE_M = 0.003
AGREEMENT = 1e-9
# The prisms of the reference scenario, in the robot frame, in m.
LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])


def measured_triplets() -> FloatArray:
    """Layout at random poses within 100 m, with noise; (TRIPLETS, 3, 3)."""
    rng = np.random.default_rng(1)
    R = Rotation.random(TRIPLETS, random_state=2).as_matrix()
    points: FloatArray = LAYOUT @ np.swapaxes(R, 1, 2) + rng.uniform(-100, 100, (TRIPLETS, 1, 3))
    return points + rng.normal(scale=NOISE_M, size=points.shape)


def loop(layout: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Align triplet by triplet (Arun et al. 1987)."""
    rotations, translations = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    layout_mean = layout.mean(axis=0)
    body = layout - layout_mean
    for i, measured in enumerate(points):
        mean = measured.mean(axis=0)
        u, _, vt = np.linalg.svd(body.T @ (measured - mean))
        if np.linalg.det(u) * np.linalg.det(vt) < 0:
            vt[2] = -vt[2]
        rotations[i] = vt.T @ u.T
        translations[i] = mean - rotations[i] @ layout_mean
    return rotations, translations


def main() -> None:
    """Check that the three agree, time them, print a table and the ratios."""
    points = measured_triplets()
    part = points[:LOOP_TRIPLETS]
    closed, batched, (rotations, translations) = (
        align_triplets(LAYOUT, points),
        align_many(LAYOUT, points),
        loop(LAYOUT, part),
    )
    difference = max(
        float(np.abs(one - other).max())
        for one, other in (
            (closed.rotation, batched.rotation),
            (closed.translation_m, batched.translation_m),
            (closed.rotation[:LOOP_TRIPLETS], rotations),
            (closed.translation_m[:LOOP_TRIPLETS], translations),
        )
    )
    if difference > AGREEMENT:
        raise SystemExit(
            f"the three do not agree: largest difference {difference:.1e}, expected at most {AGREEMENT}"
        )

    closed_s = best_s(lambda: align_triplets(LAYOUT, points), ROUNDS)
    batched_s = best_s(lambda: align_many(LAYOUT, points), ROUNDS)
    loop_s = best_s(lambda: loop(LAYOUT, part), 2) * TRIPLETS / LOOP_TRIPLETS
    print(
        f"{TRIPLETS} prism triplets, best of {ROUNDS}; loop: {LOOP_TRIPLETS} triplets, best of 2, scaled up"
    )
    for name, seconds in (("closed form", closed_s), ("batched SVD", batched_s), ("plain loop", loop_s)):
        print(f"  {name:<12} {seconds:8.3f} s  {seconds / TRIPLETS * 1e6:8.3f} us each")
    print(f"largest difference in rotation or translation (m): {difference:.1e}")
    print(f"closed form against batched SVD: {batched_s / closed_s:.1f}x faster")
    print(f"closed form against plain loop: {loop_s / closed_s:.1f}x faster")
