"""What is known of Leica's instruments by model: what no instrument says of itself.

Sources: the delays between distance and angles are constants of the University of Bonn's open tracking software
(rts-network), found by calibration there; how a name begins is as instruments of each series give it. No latency from a
measurement to the fastest answer is known of any model: published figures contain the line. It has to be measured, or
found from a recording in motion, and put into the configuration.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Model(NamedTuple):
    """What is known of a model.

    Attributes
    ----------
    angle_delay_ns
        By how much its angles are newer than its distance, in ns.
    latency_ns
        From a measurement to the fastest answer, in ns.
    precise_tape
        Whether it has the EDM mode for precise distances to tape, which came with the TS30.
    """

    angle_delay_ns: int = 0
    latency_ns: int = 0
    precise_tape: bool = False


_MODELS: Final = (
    ("TS16", Model(angle_delay_ns=7_220_000)),
    ("TS60", Model(angle_delay_ns=4_980_000, precise_tape=True)),
    ("MS60", Model(precise_tape=True)),
    ("TS30", Model(precise_tape=True)),
    ("TM30", Model(precise_tape=True)),
    ("MS50", Model(precise_tape=True)),
    ("TS50", Model(precise_tape=True)),
    ("TM50", Model(precise_tape=True)),
)


def model_of(name: str) -> Model:
    """Return what is known of the model with this name, as the instrument gives it."""
    plain = name.upper().replace(" ", "").removeprefix("LEICA").removeprefix("NOVA")
    return next((model for begin, model in _MODELS if plain.startswith(begin)), Model())
