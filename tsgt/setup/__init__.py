"""Makes a machine ready as a station or as the master: SPI, user, radio, instrument, key, configuration, services.

In: a :class:`System`, which is the machine or a folder that holds its root file system, and the operator's answers. Out: a
:class:`Step` each, which says what is right already and what would be changed; ``carry_out`` changes it. Nothing is
changed twice, and an edited configuration is never replaced unless asked for. ``files`` holds what is installed:
units, udev rules, the user, the journal's settings.
"""

from tsgt.setup.answers import (
    NO_INSTRUMENT,
    MasterAnswers,
    RadioAnswers,
    StationAnswers,
    differing_answers,
    of_mission,
)
from tsgt.setup.configuration import ConfigurationState, State, compare_configuration, uses_network
from tsgt.setup.mission import Mission, MissionError, decode_mission, encode_mission, hand_over_lines
from tsgt.setup.probe import DEFAULT_BAUD, FoundInstrument, Ports, WiringSearch, find_instruments, find_radio
from tsgt.setup.steps import (
    CLIENT,
    KEY,
    MASTER,
    USER,
    Role,
    before_restart,
    clock_step,
    configuration_step,
    journal_step,
    key_step,
    services_step,
    spi_devices,
    spi_step,
    start_step,
    system_step,
    user_step,
)
from tsgt.setup.system import Change, Ran, SetupError, Step, System, WriteFile, carry_out
from tsgt.setup.template import client_text, master_text

__all__ = [
    "CLIENT",
    "DEFAULT_BAUD",
    "KEY",
    "MASTER",
    "NO_INSTRUMENT",
    "USER",
    "Change",
    "ConfigurationState",
    "FoundInstrument",
    "MasterAnswers",
    "Mission",
    "MissionError",
    "Ports",
    "RadioAnswers",
    "Ran",
    "Role",
    "SetupError",
    "State",
    "StationAnswers",
    "Step",
    "System",
    "WiringSearch",
    "WriteFile",
    "before_restart",
    "carry_out",
    "client_text",
    "clock_step",
    "compare_configuration",
    "configuration_step",
    "decode_mission",
    "differing_answers",
    "encode_mission",
    "find_instruments",
    "find_radio",
    "hand_over_lines",
    "journal_step",
    "key_step",
    "master_text",
    "of_mission",
    "services_step",
    "spi_devices",
    "spi_step",
    "start_step",
    "system_step",
    "user_step",
    "uses_network",
]
