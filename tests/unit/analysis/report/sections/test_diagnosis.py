from __future__ import annotations

import math

from tsgt.analysis.diagnosis import Diagnosis, Finding, Part
from tsgt.analysis.report.sections.diagnosis import diagnosis_numbers, diagnosis_section

TURNED = Finding(
    cause="turned",
    where="station 2",
    size=0.312,
    sigma=0.021,
    unit="mrad",
    effect_mm=14.2,
    confidence=0.97,
    text="Station 2 is turned.",
    repair="Refine its frame.",
    alternatives=("latency of station 2",),
)
OUTLIERS = Finding(
    cause="lock_loss",
    where="station 1",
    size=math.nan,
    sigma=math.nan,
    unit="",
    effect_mm=math.nan,
    confidence=0.9,
    text="",
    repair="",
)


def test_each_cause_has_a_row() -> None:
    """With size, effect, probability and what else it may be; what has no size is unknown."""
    found = Diagnosis((TURNED, OUTLIERS), {2: (1.0, 3.04, 0.9)}, (Part("moving", 40, 0.553),))
    causes, noise, held_out = diagnosis_section(found, None).tables
    assert causes.rows == (
        ("turned", "station 2", "0.31 ± 0.021 mrad", "14.2", "97.0%", "latency of station 2"),
        ("lock loss", "station 1", "unknown", "unknown", "90.0%", "none"),
    )
    assert noise.rows == (("2", "1.00", "3.04", "0.90"),)
    assert held_out.rows == (("moving", "40", "0.55"),)
    numbers = diagnosis_numbers(found)
    assert numbers["diagnosis_noise_scales"]["2"]["horizontal_angle"] == 3.04
    assert numbers["held_out_ratios"] == [{"part": "moving", "n": 40, "continuous_to_linear": 0.553}]


def test_no_cause_is_said() -> None:
    """So is the reason why there is no diagnosis."""
    assert "None was found." in diagnosis_section(Diagnosis((), {}), None).text[0]
    assert diagnosis_section(None, "too few measurements").text == ("Unknown: too few measurements.",)
