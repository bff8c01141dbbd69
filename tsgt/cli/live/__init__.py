"""Commands on the sockets of the daemons: ``listen``, ``status``, ``replay``, and ``relay`` and ``web`` to other computers.

In: lines of a UNIX socket (`line_reader`, `follower`). Out: text, once or as lines (`status_text`, `tsgt.cli.render`), or a
screen that is updated in place (`screen`).
"""

from tsgt.cli.live.line_reader import LineReader, connect
from tsgt.cli.live.status_text import setting_lines, station_label

__all__ = ["LineReader", "connect", "setting_lines", "station_label"]
