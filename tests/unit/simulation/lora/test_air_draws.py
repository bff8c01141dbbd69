"""Loss rates of frames, and what the random draws depend on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from harness.radio.air import RecordingListener, Scene, frame, link_with_snr, listening

from tsgt.simulation.lora import LinkModel
from tsgt.simulation.lora.link import detection_probability, header_probability, payload_probability


def outcomes_of(count: int, link: LinkModel, seed: int = 0, **changes: Any) -> dict[str, int]:
    """Send many frames; return the count of each outcome, ``nothing`` included."""
    scene = Scene(link, seed)
    scene.rx.listen(listening())
    for number in range(count):
        scene.send(frame(number * 70.0, **changes))
    outcomes = scene.finish()
    counts = {what: outcomes.count(what) for what in ("received", "damaged", "lost")}
    return counts | {"nothing": count - len(outcomes)}


@pytest.mark.parametrize("snr_db", [-17.0, -16.0, -15.0, -14.0])
def test_loss_rates_match_the_link_model(snr_db: float) -> None:
    """Rates of undetected preambles, lost headers and damaged payloads are those of the link model."""
    count = 2000
    outcomes = outcomes_of(count, link_with_snr(snr_db))
    detected = detection_probability(snr_db, 9)
    headers = detected * header_probability(snr_db, 9)
    whole = headers * payload_probability(snr_db, 9, 6, 34)
    expected = {
        "nothing": 1 - detected,
        "lost": detected - headers,
        "damaged": headers - whole,
        "received": whole,
    }
    for what, probability in expected.items():
        sigma = np.sqrt(probability * (1 - probability) / count)
        assert outcomes[what] / count == pytest.approx(probability, abs=4 * sigma + 1e-9), what


def test_loss_probability_is_independent_of_power() -> None:
    """The given share of frames is lost on a perfect link."""
    outcomes = outcomes_of(2000, LinkModel(loss_probability=0.2))
    assert outcomes["nothing"] / 2000 == pytest.approx(0.2, abs=0.04)
    assert outcomes["received"] + outcomes["nothing"] == 2000


def test_rayleigh_fading_loses_frames_of_a_good_link() -> None:
    """With Rayleigh fading, some frames are lost 10 dB above the limit."""
    assert outcomes_of(500, link_with_snr(-4.0))["received"] == 500
    faded = link_with_snr(-4.0)
    faded.rayleigh_fading = True
    assert 350 < outcomes_of(500, faded)["received"] < 490


def test_same_seed_gives_the_same_outcomes() -> None:
    """Another seed gives others."""

    def outcomes_with(seed: int) -> list[tuple[int, str]]:
        scene = Scene(link_with_snr(-15.0), seed)
        scene.rx.listen(listening())
        for number in range(50):
            scene.send(frame(number * 70.0))
        scene.finish()
        return scene.listener.events

    assert outcomes_with(1) == outcomes_with(1)
    assert outcomes_with(1) != outcomes_with(2)


def test_additional_radios_do_not_change_the_draws() -> None:
    """The outcome of a frame at a receiver does not depend on other radios."""

    def outcomes_with(bystanders: int) -> list[tuple[int, str]]:
        scene = Scene(link_with_snr(-15.0))
        for number in range(bystanders):
            scene.air.join(RecordingListener(), f"bystander {number}").listen(listening())
        scene.rx.listen(listening())
        for number in range(50):
            scene.send(frame(number * 70.0))
        scene.finish()
        return scene.listener.events

    assert outcomes_with(0) == outcomes_with(3)
