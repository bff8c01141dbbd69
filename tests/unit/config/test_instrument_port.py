"""The port of an instrument: a device, or an address in the network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from tsgt.config import LeicaInstrumentConfig, TcpAddress


def config(port: Any, folder: str = "") -> LeicaInstrumentConfig:
    """Return a configuration that was read in a folder."""
    return LeicaInstrumentConfig.model_validate(
        {"kind": "leica", "port": port, "prism_type": "round"}, context={"folder": folder}
    )


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("tcp://192.168.1.10:1212", TcpAddress("192.168.1.10", 1212)),
        ("tcp://ts16.local:1212", TcpAddress("ts16.local", 1212)),
        ("tcp://[fe80::1%wlan0]:1212", TcpAddress("fe80::1%wlan0", 1212)),
    ],
)
def test_address_is_read_and_written(text: str, address: TcpAddress) -> None:
    """Host and port; it is shown as it was given."""
    read = config(text, "/etc/tsgt")
    assert read.port == address
    assert str(read.port) == text
    assert read.model_dump(mode="json")["port"] == text
    assert config(address).port == address


def test_device_is_relative_to_the_file() -> None:
    """As any other path."""
    assert config("dev/rts0", "/etc/tsgt").port == Path("/etc/tsgt/dev/rts0")
    assert config(Path("/dev/ttyUSB0")).port == Path("/dev/ttyUSB0")


@pytest.mark.parametrize(
    "port",
    [
        "tcp://192.168.1.10",
        "tcp://192.168.1.10:0",
        "tcp://192.168.1.10:70000",
        "tcp://:1212",
        "http://192.168.1.10:1212",
        "tcp://a b:1212",
        "tcp://fe80::1:1212",
        7,
    ],
)
def test_wrong_address_is_one_line(port: object) -> None:
    """With an example."""
    with pytest.raises(ValidationError, match=r"tcp://HOST:PORT") as refused:
        config(port)
    assert refused.value.error_count() == 1
