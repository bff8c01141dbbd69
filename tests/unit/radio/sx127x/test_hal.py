from __future__ import annotations

import asyncio
import errno
import os
import sys
import time
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from harness.hardware.pi import LINE, FakePi, FakeRpiGpio
from harness.hardware.radios import PAPER, make_side, running_timeline

from tsgt.config import WiringConfig
from tsgt.errors import RadioError, RadioNotFoundError, RadioSettingsError
from tsgt.radio.from_config import wiring
from tsgt.radio.sx127x import Edge, SX127x, Wiring, hal, open_hal
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, LinkModel

Backend = Literal["gpiod", "rpi-gpio"]
BACKENDS = pytest.mark.parametrize("backend", ["gpiod", "rpi-gpio"])


@pytest.fixture
def pi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePi:
    """Make a Pi with all its packages."""
    made = FakePi(tmp_path)
    monkeypatch.setattr(hal, "_DEV", tmp_path)
    monkeypatch.setitem(sys.modules, "spidev", made.spidev())
    monkeypatch.setitem(sys.modules, "gpiod", made.gpiod())
    rpi = made.rpi()
    monkeypatch.setitem(sys.modules, "RPi", rpi)
    return made


def hat(backend: Backend = "gpiod", *, nss_pin: int | None = 25, spi_hz: int = 5_000_000) -> Wiring:
    """Wire a radio like the HAT."""
    return Wiring(backend=backend, reset_pin=17, dio0_pin=4, nss_pin=nss_pin, spi_hz=spi_hz)


def rpi_gpio() -> FakeRpiGpio:
    """Return the installed fake."""
    gpio = sys.modules["RPi"].GPIO
    assert isinstance(gpio, FakeRpiGpio)
    return gpio


def test_default_wiring_is_the_hat() -> None:
    """The pins of the HAT's manual, chip select as GPIO, and kernel timestamps."""
    assert wiring(WiringConfig()) == hat()


def test_spi_clock_above_the_data_sheet_is_rejected() -> None:
    """The chip supports up to 10 MHz."""
    with pytest.raises(RadioSettingsError, match="10000000, got 10000001"):
        hat(spi_hz=10_000_001)


# --- What both backends do ----------------------------------------------------------------------------------------


@BACKENDS
def test_bus_is_opened_in_the_mode_of_the_chip(pi: FakePi, backend: Backend) -> None:
    """SPI mode 0 with the wiring's clock, the controller's own chip select off where a pin does it."""
    opened = open_hal(hat(backend, spi_hz=500_000))
    (bus,) = pi.buses
    assert (bus.mode, bus.max_speed_hz, bus.no_cs) == (0, 500_000, True)
    opened.close()


@BACKENDS
@pytest.mark.parametrize("nss_pin", [25, None])
def test_settings_of_the_program_before_are_replaced(
    pi: FakePi, backend: Backend, nss_pin: int | None
) -> None:
    """The kernel keeps mode, chip select, bit order and word size from one program to the next."""
    pi.nss_pin = nss_pin
    flags = ("no_cs", "cshigh", "lsbfirst", "loop", "threewire")
    pi.bus_settings.update(mode=3, bits_per_word=16, **dict.fromkeys(flags, True))
    opened = open_hal(hat(backend, nss_pin=nss_pin))
    found = pi.bus_settings
    assert (found["mode"], found["bits_per_word"]) == (0, 8)
    assert [found[flag] for flag in flags] == [nss_pin is not None, False, False, False, False]
    opened.close()


def test_controller_that_keeps_its_chip_select_off_is_rejected(pi: FakePi) -> None:
    """A radio on CE0 cannot be reached while the setting of the program before remains."""
    pi.bus_settings["no_cs"] = True
    pi.no_cs_error = OSError(errno.EINVAL, "Invalid argument")
    with pytest.raises(RadioError, match=r"/dev/spidev0\.0 cannot be set to mode 0, .*Invalid argument"):
        open_hal(hat(nss_pin=None))
    assert pi.open_things == 0


class LgpioError(Exception):
    """lgpio's own class is a plain Exception, too."""


@BACKENDS
@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENODEV, "No such device"),
        RuntimeError("not set up"),
        LgpioError("bad handle"),
        ValueError(),
    ],
)
def test_any_failure_of_a_pin_is_a_radio_error(pi: FakePi, backend: Backend, error: Exception) -> None:
    """Whatever a package raises at a transfer, a reset, or a look at DIO0: the driver gets its own error."""
    opened = open_hal(hat(backend))
    pi.drive_error = pi.read_error = error
    with pytest.raises(RadioError, match=r"/dev/spidev0\.0: transfer failed"):
        opened.transfer(b"\x42\x00")
    with pytest.raises(RadioError, match=r"BCM 17 \(reset\) cannot be set"):
        opened.set_reset(low=True)
    with pytest.raises(RadioError, match=r"BCM 4 \(DIO0\) cannot be read"):
        opened.dio0()
    pi.drive_error = None
    opened.close()


@BACKENDS
def test_pin_that_cannot_be_released_keeps_nothing_open(pi: FakePi, backend: Backend) -> None:
    """close() releases the bus although the GPIO chip is gone."""
    opened = open_hal(hat(backend))
    pi.release_error = LgpioError("bad handle")
    opened.close()
    assert not any(bus.is_open for bus in pi.buses)


@BACKENDS
def test_controller_without_no_cs_is_accepted(pi: FakePi, backend: Backend) -> None:
    """Where no_cs is not supported, CE0 toggles together with the pin, without effect."""
    pi.no_cs_error = OSError(errno.EINVAL, "Invalid argument")
    opened = open_hal(hat(backend))
    assert opened.transfer(b"\x42\x00") == b"\x42\x00"
    opened.close()


@BACKENDS
def test_chip_select_is_low_during_each_transfer_only(pi: FakePi, backend: Backend) -> None:
    """NSS is high at first, low during a transfer, and high again after a failure."""
    opened = open_hal(hat(backend))
    assert pi.levels[25]
    opened.transfer(b"\x42\x00")
    assert pi.nss_during_transfer == [False]
    assert pi.levels[25]
    pi.transfer_error = OSError(errno.EIO, "Input/output error")
    with pytest.raises(RadioError, match=r"/dev/spidev0.0: transfer failed: .*Input/output error"):
        opened.transfer(b"\x42\x00")
    assert pi.levels[25]
    opened.close()


@BACKENDS
def test_kernel_chip_select_needs_no_pin(pi: FakePi, backend: Backend) -> None:
    """Without an NSS pin none is requested, and the SPI driver keeps its chip select."""
    pi.nss_pin = None
    opened = open_hal(hat(backend, nss_pin=None))
    opened.transfer(b"\x42\x00")
    assert set(pi.levels) == {17, 4}
    assert not pi.buses[0].no_cs
    opened.close()


@BACKENDS
def test_reset_starts_released(pi: FakePi, backend: Backend) -> None:
    """NRESET starts released and follows set_reset()."""
    levels: list[bool] = []
    opened = open_hal(hat(backend))
    levels.append(pi.levels[17])
    for low in (True, False):
        opened.set_reset(low=low)
        levels.append(pi.levels[17])
    assert levels == [True, False, True]
    opened.close()


@BACKENDS
def test_level_of_dio0_is_read(pi: FakePi, backend: Backend) -> None:
    """dio0() is the level of the pin."""
    opened = open_hal(hat(backend))
    assert not opened.dio0()
    pi.levels[4] = True
    assert opened.dio0()
    opened.close()


@BACKENDS
async def test_close_releases_bus_and_pins(pi: FakePi, backend: Backend) -> None:
    """close() also works while edges are awaited, and may be called twice."""
    opened = open_hal(hat(backend))
    opened.on_dio0(lambda _edge: None)
    opened.close()
    opened.close()
    assert pi.open_things == 0


@BACKENDS
@pytest.mark.parametrize(
    ("pin", "hint"),
    [
        (25, r"BCM 25 \(NSS\) is in use: .*spi0-1cs,cs0_pin=25"),
        (17, r"BCM 17 \(reset\) is in use: another program"),
        (4, r"BCM 4 \(DIO0\) is in use: .*w1-gpio"),
    ],
)
def test_busy_pin_is_named_with_the_usual_cause(pi: FakePi, backend: Backend, pin: int, hint: str) -> None:
    """A pin in use is named with its role and its usual owner; everything opened is released."""
    # rpi-lgpio has an exception of its own, with this text.
    busy = OSError(errno.EBUSY, "Device or resource busy") if backend == "gpiod" else Exception("'GPIO busy'")
    pi.request_errors[pin] = busy
    with pytest.raises(RadioError, match=hint):
        open_hal(hat(backend))
    assert pi.open_things == 0


@pytest.mark.parametrize(
    ("backend", "error"),
    [
        ("gpiod", PermissionError(errno.EACCES, "Permission denied")),
        ("rpi-gpio", RuntimeError("No access to /dev/mem.  Try running as root!")),
        ("rpi-gpio", Exception("permission denied")),
    ],
)
def test_missing_permission_for_pins_names_the_group(pi: FakePi, backend: Backend, error: Exception) -> None:
    """The error names the group that the user must join."""
    pi.request_errors[17] = error
    with pytest.raises(RadioError, match="usermod -aG gpio"):
        open_hal(hat(backend))


@BACKENDS
def test_other_failures_of_a_pin_are_passed_on(pi: FakePi, backend: Backend) -> None:
    """An unknown failure is passed on with pin and role."""
    pi.request_errors[17] = OSError(errno.EINVAL, "Invalid argument")
    with pytest.raises(RadioError, match=r"BCM 17 \(reset\) is not available: .*Invalid argument"):
        open_hal(hat(backend))


@BACKENDS
async def test_driver_works_through_the_pins_of_a_pi(pi: FakePi, backend: Backend) -> None:
    """Packets pass in both directions through driver, backend, package and chip."""
    timeline = running_timeline()
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    there = make_side(air, "there")
    chip = make_side(air, "here").chip
    pi.answer = chip.transfer
    pi.on_drive = lambda pin, level: chip.set_reset(not level) if pin == 17 else None

    def edge(at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
        pi.levels[4] = level
        if level and backend == "gpiod":
            pi.requests[-1].rise(at_ns)
        elif level:
            rpi_gpio().callbacks[4](4)

    chip.on_dio(0, edge)
    here = SX127x(open_hal(hat(backend)), VirtualClock(0))
    await here.start(PAPER)
    await there.radio.start(PAPER)
    await here.transmit(b"hello")
    assert (await there.radio.receive()).payload == b"hello"
    await there.radio.transmit(b"world")
    assert (await here.receive()).payload == b"world"
    assert here.statistics.resets == 0
    await here.close()
    await there.radio.close()
    assert pi.open_things == 0


# --- The bus ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "expected", "hint"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file"), RadioNotFoundError, "raspi-config nonint do_spi 0"),
        (PermissionError(errno.EACCES, "Permission denied"), RadioError, "usermod -aG spi"),
        (OSError(errno.ENXIO, "No such device or address"), RadioError, "No such device or address"),
    ],
)
def test_failure_to_open_the_bus_names_the_remedy(
    pi: FakePi, error: OSError, expected: type[RadioError], hint: str
) -> None:
    """SPI switched off, a missing group, and other errors name the device and the remedy."""
    pi.open_error = error
    with pytest.raises(expected, match=f"/dev/spidev0.0.*{hint}"):
        open_hal(hat())


@pytest.mark.usefixtures("pi")
def test_second_program_on_the_bus_is_rejected() -> None:
    """Two programs cannot share one radio."""
    first = open_hal(hat())
    with pytest.raises(RadioError, match=r"/dev/spidev0\.0 is in use: tsgt runs twice"):
        open_hal(hat())
    first.close()
    open_hal(hat()).close()


@pytest.mark.usefixtures("pi")
@pytest.mark.parametrize(
    ("package", "backend"), [("spidev", "gpiod"), ("gpiod", "gpiod"), ("RPi", "rpi-gpio")]
)
def test_missing_package_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, package: str, backend: Backend
) -> None:
    """The error names the extra that installs the package."""
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RadioError, match=rf"package {package}.* is missing: pip install 'tsgt\[pi\]'"):
        open_hal(hat(backend))


# --- gpiod --------------------------------------------------------------------------------------------------------


def test_gpio_chip_is_found_by_its_label(pi: FakePi) -> None:
    """The chip of the pin header is found whatever its number, which differs between kernels."""
    opened = open_hal(hat())
    assert {request.path.rpartition("/")[2] for request in pi.requests} == {"gpiochip4"}
    opened.close()


def test_named_gpio_chip_is_used(pi: FakePi) -> None:
    """A configured chip is used without a search."""
    opened = open_hal(Wiring(reset_pin=17, dio0_pin=4, nss_pin=25, gpio_chip="/dev/gpiochip7"))
    assert {request.path for request in pi.requests} == {"/dev/gpiochip7"}
    opened.close()


def test_board_without_a_known_chip_is_reported(pi: FakePi) -> None:
    """The error lists the known labels and the remedy."""
    pi.labels["gpiochip4"] = "INT34C6:00"
    with pytest.raises(RadioNotFoundError, match=r"pinctrl-bcm2835, .* name it as gpio_chip"):
        open_hal(hat())
    assert pi.open_things == 0


def test_missing_permission_for_gpio_chips_names_the_group(pi: FakePi) -> None:
    """The error names the group that the user must join to open the chips."""
    pi.chip_error = PermissionError(errno.EACCES, "Permission denied")
    with pytest.raises(RadioError, match="usermod -aG gpio"):
        open_hal(hat())


def test_missing_gpio_chip_is_named(pi: FakePi) -> None:
    """A configured chip that does not exist is named."""
    pi.request_errors[25] = FileNotFoundError(errno.ENOENT, "No such file")
    with pytest.raises(RadioNotFoundError, match="no GPIO chip /dev/gpiochip7"):
        open_hal(Wiring(reset_pin=17, dio0_pin=4, nss_pin=25, gpio_chip="/dev/gpiochip7"))


def test_gpiod_version_1_is_rejected(pi: FakePi, monkeypatch: pytest.MonkeyPatch) -> None:
    """Version 1 of old systems is distinguished from version 2."""
    del pi
    monkeypatch.delattr(sys.modules["gpiod"], "request_lines")
    with pytest.raises(RadioError, match=r"gpiod is older than 2\.0"):
        open_hal(hat())


async def test_gpiod_edges_have_the_kernel_timestamp(pi: FakePi) -> None:
    """Each edge arrives with the kernel's CLOCK_MONOTONIC timestamp; gaps in the sequence numbers are lost edges."""
    opened = open_hal(hat())
    dio0 = pi.requests[-1]
    assert dio0.settings.event_clock is LINE.Clock.MONOTONIC
    assert dio0.settings.edge_detection is LINE.Edge.RISING
    edges: asyncio.Queue[Edge] = asyncio.Queue()
    opened.on_dio0(edges.put_nowait)
    dio0.rise(1_000)
    dio0.rise(2_000, lost=2)
    assert await edges.get() == Edge(1_000, lost=0)
    assert await edges.get() == Edge(2_000, lost=2)
    dio0.rise(3_000)
    assert await edges.get() == Edge(3_000, lost=0)
    assert opened.stamp_sigma_ns == 10_000
    opened.close()


def test_line_that_the_chip_does_not_have_is_named(pi: FakePi) -> None:
    """The package gpiod raises ValueError for a pin like 60."""
    pi.request_errors[17] = ValueError("invalid line offset")
    with pytest.raises(RadioError, match=r"BCM 17 \(reset\) is not available on .*gpiochip4: invalid line"):
        open_hal(hat())
    assert pi.open_things == 0


def test_chip_that_cannot_be_opened_is_named(pi: FakePi) -> None:
    """Any other failure of the search for the chip."""
    pi.chip_error = OSError(errno.ENODEV, "No such device")
    with pytest.raises(RadioError, match=r"gpiochip0 cannot be opened: .*No such device"):
        open_hal(hat())


async def test_edges_that_cannot_be_read_fail_the_next_transfer(pi: FakePi) -> None:
    """The line is read once, not for ever, and the radio is reported as broken until it is opened again."""
    opened = open_hal(hat())
    edges: list[Edge] = []
    opened.on_dio0(edges.append)
    pi.read_error = OSError(errno.ENODEV, "No such device")
    pi.requests[-1].rise(1_000)
    for _ in range(3):
        await asyncio.sleep(0)
    with pytest.raises(RadioError, match=r"edges of BCM 4 \(DIO0\) cannot be read: .*No such device"):
        opened.transfer(b"\x42\x00")
    assert not asyncio.get_running_loop().remove_reader(pi.requests[-1].fd)
    assert edges == []
    opened.close()


# --- RPi.GPIO -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("pi")
async def test_rpi_edges_are_timestamped_in_the_thread() -> None:
    """The callback timestamps an edge and passes it to the loop's thread, with a sigma of 1 ms."""
    opened = open_hal(hat("rpi-gpio"))
    edges: asyncio.Queue[Edge] = asyncio.Queue()
    opened.on_dio0(edges.put_nowait)
    assert rpi_gpio().pulls[4] == rpi_gpio().PUD_DOWN
    before_ns = time.monotonic_ns()
    await asyncio.to_thread(rpi_gpio().callbacks[4], 4)
    after_ns = time.monotonic_ns()
    edge = await edges.get()
    assert before_ns <= edge.at_ns <= after_ns
    assert edge.lost == 0
    assert opened.stamp_sigma_ns == 1_000_000
    opened.close()


@pytest.mark.usefixtures("pi")
async def test_rpi_gpio_without_interrupts_names_the_remedy() -> None:
    """Kernels since 6.6 give RPi.GPIO no interrupts."""
    rpi_gpio().detect_error = RuntimeError("Failed to add edge detection")
    opened = open_hal(hat("rpi-gpio"))
    with pytest.raises(RadioError, match=r"6\.6: use gpiod or rpi-lgpio"):
        opened.on_dio0(lambda _edge: None)
    opened.close()


@pytest.mark.usefixtures("pi")
async def test_edge_after_the_end_of_the_loop_is_dropped() -> None:
    """A callback after the loop is closed raises nothing in RPi.GPIO's thread."""
    opened = open_hal(hat("rpi-gpio"))
    other = asyncio.new_event_loop()
    other.close()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio, "get_running_loop", lambda: other)
        opened.on_dio0(lambda _edge: None)
    rpi_gpio().callbacks[4](4)
    opened.close()


def test_rpi_gpio_on_another_board_names_the_remedy(pi: FakePi, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a Pi 5 the import of RPi.GPIO itself fails."""
    del pi

    class Refusing:
        @property
        def GPIO(self) -> object:  # noqa: N802 (its name)
            raise RuntimeError("Cannot determine SOC peripheral base address")

    monkeypatch.setitem(sys.modules, "RPi", Refusing())
    with pytest.raises(RadioError, match=r"Cannot determine SOC .*use gpiod or rpi-lgpio"):
        open_hal(hat("rpi-gpio"))


def test_gpio_chip_that_rpi_lgpio_cannot_open_is_reported(pi: FakePi) -> None:
    """It is opened when the numbering of the pins is chosen."""
    rpi_gpio().mode_error = LgpioError("can not open gpiochip")
    with pytest.raises(RadioError, match="the GPIO chip is not available: can not open gpiochip"):
        open_hal(hat("rpi-gpio"))
    assert pi.open_things == 0


async def test_edges_of_lgpio_are_half_a_millisecond_old(pi: FakePi, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds them that long, and rpi-lgpio passes no timestamp on."""
    del pi
    monkeypatch.setattr(rpi_gpio(), "lgpio", object(), raising=False)
    opened = open_hal(hat("rpi-gpio"))
    edges: asyncio.Queue[Edge] = asyncio.Queue()
    opened.on_dio0(edges.put_nowait)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 10_000_000)
    rpi_gpio().callbacks[4](4)
    assert (await edges.get()).at_ns == 9_500_000
    opened.close()


def test_rpi_lgpio_is_imported_in_a_writable_folder(pi: FakePi, monkeypatch: pytest.MonkeyPatch) -> None:
    """It makes a pipe where it is imported; afterwards the working directory is as before."""
    del pi
    gpio = rpi_gpio()

    class Importing:
        @property
        def GPIO(self) -> object:  # noqa: N802 (its name)
            Path("pipe").touch()
            imported_in.append(Path.cwd())
            return gpio

    before, imported_in = Path.cwd(), list[Path]()
    monkeypatch.setitem(sys.modules, "RPi", Importing())
    monkeypatch.setenv("LG_WD", "/nowhere")
    open_hal(hat("rpi-gpio")).close()
    assert imported_in
    assert before not in imported_in
    assert not imported_in[0].exists()
    assert Path.cwd() == before
    assert os.environ["LG_WD"] == "/nowhere"
