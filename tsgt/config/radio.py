"""Configuration of radio and protocol, the same for both daemons."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Argument, Model, RelativePath, SocketPath

Pin = Annotated[int, Field(ge=0, le=1000)]


class ModemConfig(Model):
    """Modem settings; equal in all radios of a mission, except for the power."""

    frequency_mhz: Annotated[float, Field(ge=137, le=1020)]
    """Carrier frequency; legal ones depend on the country. No default."""
    spreading_factor: Annotated[int, Field(ge=7, le=12)]
    """Spreading factor, 7 to 12. No default: the paper used 9, the authors' deployed nodes use 8."""
    bandwidth_khz: Annotated[float, Field(gt=0, le=500)] = 250.0
    """Bandwidth."""
    coding_rate: Annotated[int, Field(ge=5, le=8)] = 6
    """Denominator of the coding rate: 6 for 4/6."""
    preamble_symbols: Annotated[int, Field(ge=6, le=65_535)] = 8
    """Preamble in symbols as programmed; 4.25 more are transmitted."""
    sync_word: Annotated[int, Field(ge=0, le=255)] = 0x34
    """Sync word, one byte; the authors' nodes use 0x34."""
    region: Literal["EU433", "EU868", "US915", "CA915"] | None = None
    """Region whose law applies; what violates it is refused. A real radio needs a region or a licence."""
    antenna_gain_dbi: Annotated[float, Field(ge=-40, le=40)] = 2.15
    """Gain of the antenna, less the loss of its cable and attenuator. The default is a dipole's."""
    power_dbm: Annotated[int, Field(ge=2, le=20)] | None = None
    """Power at the PA_BOOST pin, 2 to 17. Default: the most that the region allows with this antenna, else 2."""
    licence: Annotated[str, Field(min_length=3, max_length=200)] | None = None
    """Number or text of a radio licence. With a licence the limits of the region are not applied; those of the licence are not checked."""
    allow_20_dbm: bool = False
    """Allow power_dbm = 20, which the chip supports at a duty cycle of 1 % only."""


class WiringConfig(Model):
    """Wiring of the radio to the pins of a Raspberry Pi (BCM numbers); the defaults are the Dragino HAT's."""

    backend: Literal["gpiod", "rpi-gpio"] = "gpiod"
    """Access to the pins; gpiod timestamps edges in the kernel."""
    spi_bus: Pin = 0
    """B of /dev/spidevB.D."""
    spi_device: Pin = 0
    """D of /dev/spidevB.D."""
    spi_hz: Annotated[int, Field(ge=1, le=10_000_000)] = 5_000_000
    """Clock of the SPI bus; lower for long wires."""
    reset_pin: Pin = 17
    """Pin NRESET, BCM number."""
    dio0_pin: Pin = 4
    """Pin DIO0, BCM number."""
    nss_pin: Annotated[int, Field(ge=-1, le=1000)] = 25
    """Chip select, BCM number; -1 leaves it to the SPI driver of the kernel."""
    gpio_chip: Argument | None = None
    """GPIO device such as /dev/gpiochip0, gpiod only; default: found by its label."""


class HardwareRadioConfig(ModemConfig):
    """An SX1276/77/78/79 behind SPI."""

    kind: Literal["sx127x"]
    """A real radio."""
    wiring: WiringConfig = WiringConfig()
    """Wiring."""

    @model_validator(mode="after")
    def _law_is_known(self) -> HardwareRadioConfig:
        if self.region is None and self.licence is None:
            raise ValueError(
                'a radio that transmits needs its region, such as region = "EU868", or licence = "..." elsewhere'
            )
        return self


class SimulatedRadioConfig(ModemConfig):
    """A simulated chip that shares a simulated channel with others; for the demo and experiments."""

    kind: Literal["simulated"]
    """A simulated radio."""
    air_socket: SocketPath
    """UNIX socket of the air server."""
    name: str
    """Name of this radio on the channel, unique for each daemon."""


RadioConfig = Annotated[HardwareRadioConfig | SimulatedRadioConfig, Field(discriminator="kind")]


class ClassicConfig(Model):
    """The paper's polling protocol, with periodic clock synchronisation."""

    kind: Literal["classic"]
    """Name of the protocol. No default: all daemons of a mission use the same one."""


class ClassicMasterConfig(ClassicConfig):
    """Settings of the master for the protocol classic."""

    # A longer exchange would count as stalled.
    reply_timeout_ms: Annotated[float, Field(gt=0, le=30_000)] = 250.0
    """Time from the end of a request to the end of its reply, time on air included; longer where the time on air of the reply and
    100 ms exceed it (SF 10 and above)."""
    initial_cycles: Annotated[int, Field(ge=1, le=1000)] = 50
    """Exchanges of the first synchronisation of each station."""
    resync_cycles: Annotated[int, Field(ge=1, le=1000)] = 5
    """Exchanges of each later synchronisation."""
    resync_interval_s: Annotated[float, Field(ge=1, le=1e6)] = 300.0
    """Interval between synchronisations of a station; stations are staggered. With the filter `regression` the first intervals are
    30, 90 and 270 s."""
    clock_filter: Literal["regression", "paper"] = "regression"
    """Clock filter: `regression` estimates offset and skew, `paper` is the paper's low-pass with w = 0.1."""


class SuperframeConfig(Model):
    """TDMA protocol: one beacon of the master per frame, one slot per station, retransmission of lost measurements."""

    kind: Literal["superframe"]
    """Name of the protocol. No default: all daemons of a mission use the same one."""
    key_file: RelativePath | None = None
    """Key shared by all radios of a mission, made by `tsgt radio key`. Without a key anybody can take part."""


class SuperframeMasterConfig(SuperframeConfig):
    """Settings of the master for the protocol superframe; it sends the timing to the stations."""

    start_jitter_ms: Annotated[float, Field(ge=0.5, le=50)] = 5.0
    """Maximum delay of a station's transmission: usually 5, 1 to 2 with real-time priority."""
    turnaround_ms: Annotated[float, Field(ge=3, le=60)] = 8.0
    """Turnaround time of a station from the end of a beacon to the first slot."""
    clock_error_ppm: Annotated[float, Field(ge=0, le=1000)] = 100.0
    """Maximum skew between the clocks of two computers."""
    phase_lock: bool = True
    """Lock the frame phase to the instruments, to minimise the age of measurements."""


ProtocolConfig = Annotated[ClassicConfig | SuperframeConfig, Field(discriminator="kind")]
MasterProtocolConfig = Annotated[ClassicMasterConfig | SuperframeMasterConfig, Field(discriminator="kind")]

MAX_STATION_NUMBERS = {"classic": 9, "superframe": 16}
"""Largest number of a station or prism by protocol: one digit, or four bits."""


def check_numbers(protocol: ClassicConfig | SuperframeConfig, station: int, prism: int) -> None:
    """Raise ValueError for a station or prism number that a protocol cannot encode."""
    largest = MAX_STATION_NUMBERS[protocol.kind]
    if max(station, prism) > largest:
        raise ValueError(
            f"station {station} with prism {prism}: the protocol {protocol.kind} supports numbers from 1 to {largest}"
        )
