"""Checks whether a machine is ready for the field, one per possible cause of failure of a client or a master.

In comes the path of a configuration and a :class:`~tsgt.doctor.machine.Machine`, the interface to devices, commands,
users and the radio's bus. Out come findings: one line each, with what is wrong and what to type.
"""

from tsgt.doctor.checklist import run_checks
from tsgt.doctor.finding import Finding, Outcome
from tsgt.doctor.machine import (
    Machine,
    current_user,
    find_user,
    free_bytes,
    group_name,
    reach_server,
    run_command,
)

__all__ = [
    "Finding",
    "Machine",
    "Outcome",
    "current_user",
    "find_user",
    "free_bytes",
    "group_name",
    "reach_server",
    "run_checks",
    "run_command",
]
