"""What a configuration says of the radio and of the protocol that is spoken over it: the same for both daemons."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tsgt.config.base import Model, Positive, RelativePath

Pin = Annotated[int, Field(ge=0, le=1000)]


class ModemConfig(Model):
    """How packets are modulated; the same in all four radios, except for the power."""

    frequency_mhz: Annotated[float, Field(ge=137, le=1020)]
    """Carrier; which one is free depends on the country. No default."""
    spreading_factor: Annotated[int, Field(ge=7, le=12)]
    """7 to 12. No default: the paper used 9, the authors' deployed nodes use 8."""
    bandwidth_khz: Annotated[float, Field(gt=0, le=500)] = 250.0
    """Bandwidth."""
    coding_rate: Annotated[int, Field(ge=5, le=8)] = 6
    """Denominator of the coding rate: 6 for 4/6."""
    preamble_symbols: Annotated[int, Field(ge=6, le=65_535)] = 8
    """Preamble as programmed."""
    sync_word: Annotated[int, Field(ge=0, le=255)] = 0x34
    """One byte; 0x34 is that of the authors' nodes."""
    region: Literal["EU433", "EU868", "US915", "CA915"] | None = None
    """Take the power that this region allows on this channel, and refuse a channel outside its bands."""
    power_dbm: Annotated[int, Field(ge=2, le=20)] | None = None
    """Power at the PA_BOOST pin, 2 to 17. Without it that of the region, without one the least, 2."""
    allow_20_dbm: bool = False
    """Accept power_dbm = 20, which the chip bears for 1 % of the time only."""


class WiringConfig(Model):
    """How the radio is wired to the pins of a Raspberry Pi (BCM numbers); the defaults are the Dragino HAT."""

    backend: Literal["gpiod", "rpi-gpio"] = "gpiod"
    """Access to the pins; gpiod stamps edges in the kernel."""
    spi_bus: Pin = 0
    """B of /dev/spidevB.D."""
    spi_device: Pin = 0
    """D of /dev/spidevB.D."""
    spi_hz: Annotated[int, Field(ge=1, le=10_000_000)] = 5_000_000
    """Clock of the bus; lower for long wires."""
    reset_pin: Pin = 17
    """NRESET."""
    dio0_pin: Pin = 4
    """DIO0."""
    nss_pin: Annotated[int, Field(ge=-1, le=1000)] = 25
    """Chip select; -1 leaves it to the SPI driver of the kernel."""
    gpio_chip: str | None = None
    """As /dev/gpiochip0; found by its label if not given."""


class HardwareRadioConfig(ModemConfig):
    """An SX1276/77/78/79 behind SPI."""

    kind: Literal["sx127x"]
    """The radio is real."""
    wiring: WiringConfig = WiringConfig()
    """Where its pins go."""


class SimulatedRadioConfig(ModemConfig):
    """A simulated chip that shares the air of an air server with others; for the demo and for trying things."""

    kind: Literal["simulated"]
    """The radio is simulated."""
    air_socket: RelativePath
    """UNIX socket of the air server."""
    name: str
    """Name of this radio on the air, another one for each daemon."""


RadioConfig = Annotated[HardwareRadioConfig | SimulatedRadioConfig, Field(discriminator="kind")]


class ClassicConfig(Model):
    """The paper's protocol: the master polls one station after the other, and synchronises clocks now and then."""

    kind: Literal["classic"]
    """Name of the protocol. There is no default: all daemons of a mission speak the same one."""


class ClassicMasterConfig(ClassicConfig):
    """The paper's protocol as the master runs it."""

    reply_timeout_ms: Positive = 250.0
    """How long a station may take to answer, besides what a long reply needs on the air."""
    initial_cycles: Annotated[int, Field(ge=1, le=1000)] = 50
    """Cycles of the first synchronisation of each station."""
    resync_cycles: Annotated[int, Field(ge=1, le=1000)] = 5
    """Cycles of each later synchronisation."""
    resync_interval_s: Positive = 300.0
    """From one synchronisation of a station to its next; stations are staggered."""
    clock_filter: Literal["regression", "paper"] = "regression"
    """How offsets become a clock: `regression` follows drift, `paper` is the paper's low-pass with w = 0.1."""


class SuperframeConfig(Model):
    """One beacon of the master per frame, then one slot for each station: every measurement gets through."""

    kind: Literal["superframe"]
    """Name of the protocol. There is no default: all daemons of a mission speak the same one."""
    key_file: RelativePath | None = None
    """The key that all radios of a mission share, made by `tsgt radio key`. Without one anybody can take part."""


class SuperframeMasterConfig(SuperframeConfig):
    """The same as the master runs it; what it says of time it tells the stations itself."""

    start_jitter_ms: Annotated[float, Field(ge=0.5, le=50)] = 5.0
    """How late a station's computer starts a transmission at worst: 5 as a rule, 1 to 2 with real-time priority."""
    turnaround_ms: Annotated[float, Field(ge=3, le=60)] = 8.0
    """What a station's computer needs from the end of a beacon to its first slot."""
    clock_error_ppm: Annotated[float, Field(ge=0, le=1000)] = 100.0
    """By how much two computers' clocks may run apart."""
    phase_lock: bool = True
    """Let the frame follow the instruments, so that their measurements wait as short as can be."""


ProtocolConfig = Annotated[ClassicConfig | SuperframeConfig, Field(discriminator="kind")]
MasterProtocolConfig = Annotated[ClassicMasterConfig | SuperframeMasterConfig, Field(discriminator="kind")]

LARGEST_NUMBERS = {"classic": 9, "superframe": 16}
"""Of stations and prisms: one digit, or four bits."""


def check_numbers(protocol: ClassicConfig | SuperframeConfig, station: int, prism: int) -> None:
    """Refuse numbers that a protocol cannot send.

    Raises
    ------
    ValueError
        With the limit.
    """
    largest = LARGEST_NUMBERS[protocol.kind]
    if max(station, prism) > largest:
        raise ValueError(
            f"station {station} with prism {prism}: the protocol {protocol.kind} can send numbers from 1 to {largest}"
        )
