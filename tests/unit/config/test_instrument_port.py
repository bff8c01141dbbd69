"""Keys of an instrument: its port, a device or an address in the network; reflector and search."""

from __future__ import annotations

import re
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


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"prism_type": "user"}, 'prism_type = "user" needs prism_constant_mm'),
        ({"search_distance_m": (100, 20)}, "search_distance_m: 20 must be at least 10 above 100"),
        ({"search_distance_m": (100, 109)}, "search_distance_m: 109 must be at least 10 above 100"),
    ],
)
def test_keys_that_contradict_each_other_are_refused(keys: dict[str, object], problem: str) -> None:
    """The distances would be off by what the last surveyor left; the prism would not be searched where it is."""
    good = {"kind": "leica", "port": "/dev/ttyUSB0", "prism_type": "round"}
    with pytest.raises(ValidationError, match=re.escape(problem)):
        LeicaInstrumentConfig.model_validate({**good, **keys}, context={"folder": ""})


def test_instrument_may_search_ten_metres() -> None:
    """The least that it accepts."""
    good = {"kind": "leica", "port": "/dev/ttyUSB0", "prism_type": "user", "prism_constant_mm": 0.0}
    config = LeicaInstrumentConfig.model_validate(
        {**good, "search_distance_m": (100, 110)}, context={"folder": ""}
    )
    assert config.search_distance_m == (100, 110)
