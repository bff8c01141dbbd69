"""The condition of a station's instrument over the radio: one item per status report, in turn. Sans-I/O.

Battery, atmospheric correction and what the instrument does change slowly, and nothing waits for them. So a status report has
room for one of them, and the bits that it takes are those that the LoRa code block of such a reply had left: no reply takes
longer on the air. Texts of the instrument and of bridge programs become the words below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from tsgt.radio.superframe.wire import CONDITION_VALUE_BITS, ConditionItem

_PPM_STEPS: Final = 2  # per 1e-6
_PPM_ZERO: Final = 1 << CONDITION_VALUE_BITS - 1
_MAX_VALUE: Final = (1 << CONDITION_VALUE_BITS) - 1

ACTIVITIES: Final = (
    ("", ()),
    ("starting", ("starting",)),
    ("tracking", ("tracking",)),
    ("searching for the prism", ("searching", "recognising")),
    ("waiting for the prism to come back", ("waiting for the prism",)),
    ("pausing between searches", ("pausing",)),
    ("waiting for the telescope to be pointed at the prism", ("waiting for the telescope",)),
    ("ready for single measurements", ("ready",)),
)
"""By code: the words at the master, and how the instrument's text begins. Any other text is code 0."""

PROBLEMS: Final = (
    ("it is not level", ("level",)),
    ("point the telescope at the prism", ("point the telescope",)),
    ("change its battery", ("battery",)),
    ("the licence GeoCOM Robotic is missing", ("licence",)),
    (
        "a setting is not as required",
        ("cannot be set", "cannot be read", "scales distances", "not as required"),
    ),
    ("see `tsgt status` there", ("tsgt status",)),
)
"""By bit: the words at the master, and what the instrument's text contains; the last bit is also for any other text."""

NO_INSTRUMENT: Final = "no instrument is connected"


class ConditionKind(IntEnum):
    """What an item contains; 3 is not assigned, and a master ignores it."""

    BATTERY = 0
    ATMOSPHERE = 1
    STATE = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentCondition:
    """Condition of an instrument; None where unknown.

    Attributes
    ----------
    battery_percent
        Charge of its battery, 0 to 100.
    atmospheric_ppm
        Scale correction of its distances in 1e-6; over the radio in steps of 0.5 from -127.5 to 127.5, where the ends mean
        that or beyond.
    activity, problem
        Current activity, and what requires the operator; empty for none.
    """

    battery_percent: int | None = None
    atmospheric_ppm: float | None = None
    activity: str | None = None
    problem: str | None = None


UNKNOWN_CONDITION: Final = InstrumentCondition()


def condition_items(condition: InstrumentCondition) -> dict[ConditionKind, int]:
    """Return the value of each kind of item; 0: unknown, or nothing to say."""
    battery, ppm = condition.battery_percent, condition.atmospheric_ppm
    text = condition.activity or ""
    activity = next(
        (code for code, (_, begins) in enumerate(ACTIVITIES) if begins and text.startswith(begins)), 0
    )
    return {
        ConditionKind.STATE: activity << len(PROBLEMS) | _problem_bits(condition.problem or ""),
        ConditionKind.BATTERY: 0 if battery is None else min(max(battery, 0), 100) + 1,
        ConditionKind.ATMOSPHERE: 0 if ppm is None else _ppm_code(ppm),
    }


def _ppm_code(ppm: float) -> int:
    """Limit before rounding: a bridge program may report any finite number."""
    most = (_MAX_VALUE - _PPM_ZERO) / _PPM_STEPS
    return round(min(max(ppm, -most), most) * _PPM_STEPS) + _PPM_ZERO


def _problem_bits(text: str) -> int:
    known = sum(1 << bit for bit, (_, parts) in enumerate(PROBLEMS) if any(part in text for part in parts))
    return known or bool(text) << len(PROBLEMS) - 1


def updated_condition(condition: InstrumentCondition, item: ConditionItem) -> InstrumentCondition:
    """Return the condition after an item; one that means nothing here leaves it as it is."""
    value = item.value
    match item.kind:
        case ConditionKind.BATTERY if value <= 101:
            return replace(condition, battery_percent=value - 1 if value else None)
        case ConditionKind.ATMOSPHERE:
            return replace(condition, atmospheric_ppm=(value - _PPM_ZERO) / _PPM_STEPS if value else None)
        case ConditionKind.STATE:
            activity, problems = divmod(value, 1 << len(PROBLEMS))
            found = [words for bit, (words, _) in enumerate(PROBLEMS) if problems >> bit & 1]
            return replace(condition, activity=ACTIVITIES[activity][0], problem="; ".join(found))
        case _:
            return condition


class ConditionReporter:
    """Chooses the item of each status report: what the master may not know comes first, in turn."""

    def __init__(self) -> None:
        self._acknowledged: dict[int, int] = {}
        self._sent = list(ConditionKind)[-1]

    def next(self, condition: InstrumentCondition) -> ConditionItem:
        """Return the item of a status report now."""
        values = condition_items(condition)
        changed = [kind for kind, value in values.items() if self._acknowledged.get(kind) != value]
        kinds = sorted(changed or values)
        kind = next((kind for kind in kinds if kind > self._sent), kinds[0])
        return ConditionItem(kind, values[kind])

    def sent(self, item: ConditionItem) -> None:
        """Take an item as sent."""
        self._sent = ConditionKind(item.kind)

    def acknowledged(self, item: ConditionItem) -> None:
        """Take an item as acknowledged."""
        self._acknowledged[item.kind] = item.value
