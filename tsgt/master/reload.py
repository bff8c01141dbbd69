"""Takes other set-up files while the master runs, on a signal: the first ones, or those after a tripod was set up again."""

from __future__ import annotations

import asyncio
import signal
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tsgt.errors import ConfigError, DegenerateGeometryError
from tsgt.estimation import LiveEstimator
from tsgt.master.link_events import MasterEvent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tsgt.model import Parameters

RELOAD_SIGNAL = signal.SIGUSR1
"""Not SIGHUP, which a lost terminal sends as well: it ends the master."""


def usable_setup(read: Callable[[], Parameters]) -> Parameters:
    """Read the set-up files; raises ConfigError if they cannot be read or give no poses."""
    parameters = read()
    if parameters.no_poses is not None:
        raise ConfigError(parameters.no_poses)
    try:
        LiveEstimator(parameters)
    except DegenerateGeometryError as error:
        raise ConfigError(str(error)) from error
    return parameters


@contextmanager
def reloading(
    read: Callable[[], Parameters] | None,
    set_up: Callable[[Parameters], None],
    report: Callable[[MasterEvent], None],
) -> Iterator[None]:
    """Read and apply the set-up files at each signal; the event ``setup_applied`` or ``setup_rejected`` follows.

    What cannot be read or gives no poses is rejected, and the old set-up remains. ``read`` None: do nothing.
    """
    if read is None:
        yield
        return

    def reload() -> None:
        try:
            parameters = usable_setup(read)
        except ConfigError as error:
            report(MasterEvent("setup_rejected", f"the old set-up remains in force: {error}"))
        else:
            set_up(parameters)
            stations = ", ".join(str(each.station) for each in parameters.stations)
            prisms = ", ".join(str(each.prism) for each in parameters.prisms)
            message = f"new set-up in force: frames of stations {stations}; prisms {prisms}"
            report(MasterEvent("setup_applied", message))

    loop = asyncio.get_running_loop()
    loop.add_signal_handler(RELOAD_SIGNAL, reload)
    try:
        yield
    finally:
        loop.remove_signal_handler(RELOAD_SIGNAL)
        signal.signal(
            RELOAD_SIGNAL, signal.SIG_IGN
        )  # the default would kill the master while it ends or restarts
