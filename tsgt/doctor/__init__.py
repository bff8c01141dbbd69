"""Whether a machine is ready for the field: one check per thing that keeps a client or a master from working.

Each check returns findings: one line that says in plain words what is wrong and what to type. What is outside (devices,
commands, users, the radio's bus) is handed in as a :class:`~tsgt.doctor.machine.Machine`.
"""

from tsgt.doctor.checklist import examine
from tsgt.doctor.finding import Finding, Outcome
from tsgt.doctor.machine import Machine, current_user, find_user, free_bytes, group_name, run_command

__all__ = [
    "Finding",
    "Machine",
    "Outcome",
    "current_user",
    "examine",
    "find_user",
    "free_bytes",
    "group_name",
    "run_command",
]
