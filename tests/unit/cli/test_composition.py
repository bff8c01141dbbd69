"""Parts that the daemons are made of."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tsgt.cli.composition import make_instrument
from tsgt.config import ClientConfig, load
from tsgt.errors import InstrumentError
from tsgt.simulation.kernel import VirtualClock

CONFIGS = Path(__file__).parents[3] / "configs"

# Imports of a client with a Leica instrument.
CLIENT = f"""
import sys
from pathlib import Path
from tsgt.cli.composition import make_instrument
from tsgt.clock import SystemClock
from tsgt.config import ClientConfig, load
import tsgt.cli.daemons, tsgt.station.daemon
make_instrument(load(Path({str(CONFIGS)!r}) / "client.example.toml", ClientConfig).instrument, SystemClock())
print(*[name for name in ("numpy", "scipy", "matplotlib", "rich", "tsgt.simulation") if name in sys.modules])
"""


@pytest.mark.parametrize(
    ("example", "kind"), [("client", "LeicaInstrument"), ("client.bridge", "BridgeInstrument")]
)
async def test_each_kind_of_instrument_is_made(example: str, kind: str) -> None:
    """An instrument that is not connected needs neither port nor program."""
    config = load(CONFIGS / f"{example}.example.toml", ClientConfig)
    instrument = make_instrument(config.instrument, VirtualClock(0))
    assert type(instrument).__name__ == kind
    with pytest.raises(InstrumentError, match=r"usb-FTDI|s7-bridge"):
        await instrument.connect()
    await instrument.close()


@pytest.mark.slow
def test_client_loads_no_heavy_libraries() -> None:
    """A station client starts without scipy, matplotlib and rich."""
    done = subprocess.run([sys.executable, "-c", CLIENT], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
