from __future__ import annotations

import math

import pytest

from tsgt.web.mission.verdict import GOOD, Finding, Hold, Level, PoseFacts, StreamFacts, judge

LIVE = StreamFacts(connected=True)
VALID = PoseFacts(age_s=0.05, valid=True)
FENCE = Finding(Level.CARE, "outside the geofence site", urgent=True)
STATION = Finding(Level.CARE, "station 2: no prism")


@pytest.mark.parametrize(
    ("stream", "pose", "others", "words", "cause"),
    [
        (LIVE, VALID, [], "GOOD", "all stations track, the pose is valid"),
        (LIVE, VALID, [STATION], "CARE", "station 2: no prism"),
        (LIVE, VALID, [STATION, FENCE], "CARE", "outside the geofence site"),
        (LIVE, PoseFacts(age_s=0.05, valid=True, degradations=("d",)), [FENCE], "CARE", FENCE.cause),
        (LIVE, PoseFacts(age_s=0.05, valid=False, explanation="e"), [FENCE], "NO POSE", "e"),
        (LIVE, PoseFacts(age_s=1.1, valid=True), [], "NO POSE", "no pose for 1 s: w"),
        (LIVE, None, [], "NO POSE", "no pose yet: w"),
        (StreamFacts(connected=False, problem="p"), VALID, [FENCE], "STREAM STOPPED", "p"),
        (StreamFacts(connected=True, silence_s=1.6), VALID, [], "STREAM STOPPED", "the master has sent nothing for 2 s"),
        (StreamFacts(connected=True, delay_s=4.0), VALID, [], "STREAM STOPPED", "the stream arrives 4 s late"),
        (StreamFacts(connected=True, delay_s=math.inf), VALID, [], "STREAM STOPPED", "the stream arrives late"),
    ],
)  # fmt: skip
def test_verdict_is_the_worst_with_its_cause(
    stream: StreamFacts, pose: PoseFacts | None, others: list[Finding], words: str, cause: str
) -> None:
    """Each state gives its word and one line; what is unknown without a stream is not mentioned."""
    first = judge(stream, pose, "w", others)[0]
    assert (first.level.words, first.cause) == (words, cause)


def test_text_that_begins_another_one_is_no_repetition() -> None:
    """Two geofences with names that begin alike are two findings; the same finding with more detail is one."""
    pit, road, full = (
        Finding(Level.CARE, text)
        for text in ("outside the geofence pit", "outside the geofence pit road", "the disk is full")
    )
    left = Finding(Level.CARE, "the disk is full: 3 MB left")
    assert judge(LIVE, VALID, "w", [pit, full, road, left]) == [pit, road, left]


def test_nothing_else_is_claimed_without_a_stream() -> None:
    """A station's state of ten seconds ago is not an alarm of now."""
    assert len(judge(StreamFacts(connected=False, problem="p"), VALID, "w", [FENCE, STATION])) == 1


def test_worse_verdict_is_shown_at_once() -> None:
    """Never a stale green."""
    hold = Hold()
    assert hold.update(GOOD, 0.0) is GOOD
    assert hold.update(FENCE, 0.1) is FENCE


def test_better_verdict_is_shown_after_a_second() -> None:
    """So that one can read the cause of what lasts for a moment only."""
    hold = Hold()
    hold.update(FENCE, 0.0)
    assert hold.update(GOOD, 0.9) is FENCE
    assert hold.update(GOOD, 1.0) is GOOD
