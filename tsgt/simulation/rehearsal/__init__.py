"""Rehearsal of a day in the field: the real daemons and commands, with instruments, robot and radio simulated in real time.

In: a folder and a seed. Out: a `Site` on which the operator works with the same commands as outside. What is done by hand
outside (aiming, changing batteries) a simulated helper does, by himself or told by `./helper`; `./systemctl` stands for systemd.
"""

from tsgt.simulation.rehearsal.scenario import MOVED_TRIPOD, SCENARIO, TARGETS
from tsgt.simulation.rehearsal.site import Site

__all__ = ["MOVED_TRIPOD", "SCENARIO", "TARGETS", "Site"]
