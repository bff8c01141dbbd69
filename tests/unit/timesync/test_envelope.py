"""The lower envelope of randomly delayed responses."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync.envelope import fit_lower_envelope, minimum_delay

SPREAD = 40.0


@pytest.mark.parametrize("count", [12, 100, 1000])
def test_minimum_delay_matches_trials(count: int) -> None:
    """Mean and sigma are those of many trials, with small and large truncation."""
    random = np.random.default_rng(1)
    heights = random.uniform(0, SPREAD, (4000, count)) + random.uniform(0, 1, (4000, count))
    found = minimum_delay(SPREAD / (count + 1))
    assert found.mean == pytest.approx(heights.min(axis=1).mean(), rel=0.25)
    assert found.sigma == pytest.approx(heights.min(axis=1).std(), rel=0.25)


def test_stated_sigma_matches_the_errors() -> None:
    """Over many trials the extrapolated line has hardly any bias, and errors of the stated sigma."""
    random = np.random.default_rng(2)
    errors = []
    for _ in range(200):
        x = np.sort(random.uniform(0, 1000, 60))
        slope = random.normal(0, 0.01)
        y = slope * x + random.uniform(0, SPREAD, 60)
        scale = SPREAD / 61
        line = fit_lower_envelope(
            list(zip(x.tolist(), y.tolist(), strict=True)),
            centre=float(x.mean()),
            scale=scale,
            prior=(0.0, 0.01),
            max_slope=0.05,
        )
        error = line.height - scale + line.slope * 1000 - slope * 1000
        errors.append(
            error / np.hypot(np.hypot(scale, line.pivot_sigma), line.slope_sigma * (1000 - line.pivot))
        )
    assert abs(np.mean(errors)) < 0.4
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_single_response_keeps_the_prior_slope() -> None:
    """The prior slope and its sigma remain."""
    line = fit_lower_envelope([(3.0, 5.0)], centre=3.0, scale=1.0, prior=(1e-3, 1e-3), max_slope=1e-2)
    assert line.slope == pytest.approx(1e-3, rel=1e-2)
    assert line.slope_sigma == pytest.approx(1e-3, rel=5e-2)
    assert line.height + line.slope * 3 == pytest.approx(5.0)
