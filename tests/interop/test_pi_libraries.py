"""The real packages of a Raspberry Pi: every name that we use, and what we make of their errors (`make test-libs` installs them)."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from harness.hardware.pi import LINE, FakePi, FakeRpiGpio

from tsgt.radio.sx127x import hal

ROOT = Path(__file__).parents[2]
ENVIRONMENTS = ROOT / ".pi-libs"
REVISION_OF_A_PI_4 = "c03111"


@pytest.fixture(scope="module")
def examine() -> Any:
    """Return what a program finds that runs in one of the environments."""
    results: dict[str, dict[str, Any]] = {}

    def run(name: str) -> dict[str, Any]:
        python = ENVIRONMENTS / name / "bin" / "python"
        if not python.exists():
            pytest.skip(f"no {python.relative_to(ROOT)}: run `make test-libs`")
        if name not in results:
            script = Path(__file__).parent / "examine_pi_libraries.py"
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "RPI_LGPIO_REVISION": REVISION_OF_A_PI_4}
            done = subprocess.run(
                [python, script, str(hal.__file__), name],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            results[name] = json.loads(done.stdout)
        return results[name]

    return run


def public(fake: object) -> set[str]:
    """Return the names that a fake has, and we use."""
    return {name for name in dir(fake) if not name.startswith("_")}


@pytest.mark.parametrize("name", ["rpi-lgpio", "rpi-gpio"])
def test_spidev_has_what_we_use(examine: Any, tmp_path: Path, name: str) -> None:
    """All names of the fake that the tests use, and the settings."""
    pi = FakePi(tmp_path)
    bus = pi.spidev().SpiDev()
    assert public(bus) - {"is_open"} | set(pi.bus_settings) <= set(examine(name)["spidev"]["names"])


def test_spidev_raises_what_we_catch(examine: Any) -> None:
    """A bus that is not there, and one that is not open; we name the remedy."""
    found = examine("rpi-lgpio")["spidev"]
    assert found["no bus"].startswith("FileNotFoundError")
    assert found["not open"].startswith("OSError")
    assert found["open_hal"].startswith("RadioNotFoundError: there is no /dev/spidev7.7: switch SPI on")


def test_gpiod_has_what_we_use(examine: Any, tmp_path: Path) -> None:
    """Functions, parameters and values of the fake."""
    found = examine("rpi-lgpio")["gpiod"]
    assert {"path", "consumer", "config", "event_buffer_size"} <= set(found["request_lines"])
    settings = {"direction", "output_value", "edge_detection", "bias", "event_clock"}
    assert settings <= set(found["LineSettings"])
    assert {"fd", "set_value", "get_value", "read_edge_events", "release"} <= set(found["LineRequest"])
    assert {"timestamp_ns", "line_seqno"} <= set(found["EdgeEvent"])
    assert "label" in found["ChipInfo"]
    assert public(FakePi(tmp_path).gpiod().Chip) <= set(found["Chip"])
    for name, values in vars(LINE).items():
        assert {each.name for each in values} <= set(found["line"][name])


def test_gpiod_raises_what_we_catch(examine: Any) -> None:
    """A chip that is not there, and a file that is none."""
    found = examine("rpi-lgpio")["gpiod"]
    assert found["no chip"].startswith("FileNotFoundError")
    assert found["open"]["/dev/gpiochip77"].startswith("RadioNotFoundError: there is no GPIO chip")
    assert found["open"]["/dev/null"].startswith("RadioError: BCM 25 (NSS) is not available")


def test_rpi_lgpio_has_what_we_use(examine: Any, tmp_path: Path) -> None:
    """It is imported although the working directory is not writable, which stays; its chip's error is ours."""
    found = examine("rpi-lgpio")["rpi"]
    assert found["open"].startswith("RadioError: the GPIO chip is not available: 'can not open gpiochip'")
    assert found["cwd"] == "/proc"
    fields = {"pi", "detect_error", "mode_error", "callbacks", "pulls", "mode"}
    assert public(FakeRpiGpio(FakePi(tmp_path))) - fields <= set(found["names"])
    assert "lgpio" in found["names"]
    assert {"initial", "pull_up_down"} <= set(found["parameters"]["setup"])
    assert "callback" in found["parameters"]["add_event_detect"]


def test_rpi_gpio_on_another_board_is_reported(examine: Any) -> None:
    """It refuses to be imported with a RuntimeError."""
    found = examine("rpi-gpio")["rpi"]["open"]
    assert found.startswith(
        "RadioError: RPi.GPIO does not work on this board (This module can only be run on a"
    )
