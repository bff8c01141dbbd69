"""A configuration that exists beside the one that setup would write: the same, as setup wrote it, or edited by hand."""

from __future__ import annotations

import difflib
import tomllib
from dataclasses import dataclass
from enum import StrEnum

from tsgt.setup.template import content_lines, sealed_by_setup


class State(StrEnum):
    """State of the configuration on a machine."""

    MISSING = "missing"
    SAME = "same"
    FROM_SETUP = "from_setup"  # written by setup with other answers, not edited since
    EDITED = "edited"


@dataclass(frozen=True, slots=True)
class ConfigurationState:
    """State of a configuration, and the lines in which it differs from the new one, as a unified diff."""

    state: State
    differences: tuple[str, ...] = ()


def compare_configuration(before: str | None, new: str, name: str) -> ConfigurationState:
    """Compare a configuration with the text that setup would write into the file ``name``."""
    if before is None:
        return ConfigurationState(State.MISSING)
    if before == new:
        return ConfigurationState(State.SAME)
    lines = difflib.unified_diff(
        content_lines(before), content_lines(new), name, f"{name} as setup would write it", n=0, lineterm=""
    )
    state = State.FROM_SETUP if sealed_by_setup(before) else State.EDITED
    return ConfigurationState(state, tuple(lines))


def uses_network(text: str) -> bool | None:
    """Whether the instrument of a configuration is in the network; None if it does not say so: a bridge, a master."""
    try:
        instrument = tomllib.loads(text).get("instrument")
    except tomllib.TOMLDecodeError:
        return None
    port = instrument.get("port") if isinstance(instrument, dict) else None
    return port.startswith("tcp://") if isinstance(port, str) else None
