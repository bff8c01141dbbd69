"""The command line: thin commands over the other rooms, and the only place that imports click.

In come arguments and files, out go results on stdout, logs on stderr and an exit code. ``main`` holds the table of
commands and ``daemons`` the entry points of the daemons; the sub-rooms hold groups of commands, and ``options``,
``model_options``, ``output`` and ``progress`` what they share.
"""

import os
import sys

# Before numpy is loaded: the matrices are small, and a second thread doubles the time of `tsgt evaluate` on two cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# structlog loads rich if it is installed; a station client is small and starts without it.
if "rich" not in sys.modules and "structlog" not in sys.modules:
    sys.modules["rich"] = None  # type: ignore[assignment]
    import structlog  # noqa: F401

    del sys.modules["rich"]
