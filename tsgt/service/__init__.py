"""Services to a daemon: orderly shutdown, systemd, periodic sync to disk, UNIX sockets, and supervised programs.

`daemon` are the first ones; `program` runs a child process that prints lines, which `program_lines` splits and rejects; `command` runs one once;
`log_limiter` limits warnings that could be logged with every line or packet.
"""

from tsgt.service.command import run_command
from tsgt.service.daemon import (
    MAX_SOCKET_PATH_BYTES,
    UnixListener,
    notify_systemd,
    run,
    sd_notify,
    sync_periodically,
    until_suspended,
    watchdog_interval_s,
)
from tsgt.service.log_limiter import LogLimiter
from tsgt.service.program import Listener, Program, StartProgram, start_process
from tsgt.service.program_lines import LineSplitter, RejectedLines, printable

__all__ = [
    "MAX_SOCKET_PATH_BYTES",
    "LineSplitter",
    "Listener",
    "LogLimiter",
    "Program",
    "RejectedLines",
    "StartProgram",
    "UnixListener",
    "notify_systemd",
    "printable",
    "run",
    "run_command",
    "sd_notify",
    "start_process",
    "sync_periodically",
    "until_suspended",
    "watchdog_interval_s",
]
