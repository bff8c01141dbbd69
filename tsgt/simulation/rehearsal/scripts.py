"""Two shell scripts in the folder of a rehearsal: `systemctl` for the services, `helper` for what hands do outside."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

ORDERS = "orders"
"""FIFO through which the scripts speak to the rehearsal."""

_SYSTEMCTL = """\
#!/bin/sh
# Stands for `sudo systemctl` in the rehearsal: start, stop, restart or reload tsgt-master.
cd "$(dirname "$0")" || exit 1
[ -p orders ] || { echo "the rehearsal is not running" >&2; exit 1; }
case "$1 $2" in
    "start tsgt-master") echo start > orders; while [ ! -S poses.sock ]; do sleep 0.1; done ;;
    "stop tsgt-master") echo stop > orders; while [ -S poses.sock ]; do sleep 0.1; done ;;
    "restart tsgt-master") "$0" stop tsgt-master && "$0" start tsgt-master ;;
    "reload tsgt-master") echo reload > orders ;;
    *) echo "usage: ./systemctl start|stop|restart|reload tsgt-master" >&2; exit 2 ;;
esac
"""

_HELPER = """\
#!/bin/sh
# Tells the helper at a tripod what to do: aim STATION TARGET, clear STATION, or battery STATION.
cd "$(dirname "$0")" || exit 1
[ -p orders ] || { echo "the rehearsal is not running" >&2; exit 1; }
case "$1 $#" in
    "aim 3") echo "aim $2 $3" > orders && echo "the helper aims station $2 at target $3" ;;
    "clear 2") echo "clear $2" > orders && echo "the helper clears the line of sight of station $2" ;;
    "battery 2") echo "battery $2" > orders && echo "the helper changes the battery of station $2" ;;
    *) echo "usage: ./helper aim STATION TARGET | clear STATION | battery STATION" >&2; exit 2 ;;
esac
"""


def write_scripts(folder: Path) -> None:
    """Write both scripts, executable."""
    for name, text in (("systemctl", _SYSTEMCTL), ("helper", _HELPER)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
