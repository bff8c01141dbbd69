from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Any

import pytest
from harness.instruments.bridge import COMMANDS, HELLO, FakeProgram, FakeStart, measured
from structlog.testing import capture_logs

from tsgt.config import BridgeInstrumentConfig
from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.model import Status
from tsgt.radio import Direction
from tsgt.simulation.kernel import VirtualClock
from tsgt.station import Atmosphere
from tsgt.station.bridge import BridgeInstrument
from tsgt.station.instrument_supervisor import InstrumentSupervisor
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from tsgt.station import Reading

CLOCK = VirtualClock(0)
CONFIG = BridgeInstrumentConfig(kind="bridge", command=("bridge",))
FULL = HELLO | {"commands": COMMANDS}


async def tracking(
    hello: dict[str, Any] = FULL, config: BridgeInstrumentConfig = CONFIG
) -> tuple[BridgeInstrument, FakeProgram, FakeStart]:
    """Connect to a program and track prism 1, a minute after the start of the clock."""
    await asyncio.sleep(max(0.0, 60.0 - CLOCK.monotonic_ns() / 1e9))
    start = FakeStart(CLOCK, hello)
    instrument = BridgeInstrument(config, CLOCK, start)
    await instrument.connect()
    await instrument.track(1)
    return instrument, start.programs[0], start


async def queued(instrument: BridgeInstrument) -> list[Reading]:
    """Return all queued readings."""
    readings = []
    try:
        while True:
            async with asyncio.timeout(0):
                readings.append(await instrument.read())
    except TimeoutError:
        return readings


async def test_connect_returns_identity_and_timestamp_source() -> None:
    """Both come from hello."""
    hello = {"model": "S7", "serial_number": "12", "firmware": "1.2", "make": "Acme"}
    for stamps, how in (
        ({"stamps": "host"}, "timestamped by the bridge"),
        ({"stamps": "instrument", "clock": "UTC"}, "timestamped by its clock UTC"),
        ({"stamps": "arrival"}, "timestamped on arrival"),
    ):
        instrument = BridgeInstrument(CONFIG, CLOCK, FakeStart(CLOCK, HELLO | hello | stamps))
        assert await instrument.connect() == f"Acme S7 12, {how}"


async def test_reading_has_values_of_line() -> None:
    """The latency is subtracted from the timestamp."""
    config = CONFIG.model_copy(update={"latency_ms": 20.0})
    instrument, program, _ = await tracking(config=config)
    now_ns = CLOCK.monotonic_ns()
    program.measure(
        12.5,
        status="low_accuracy",
        raw_status=1284,
        host_time_ns=now_ns - 1_000_000,
        instrument_time_ns=7,
        unknown="key",
    )
    reading = await instrument.read()
    assert reading.at_ns == now_ns - 21_000_000
    assert reading.received_ns == now_ns
    assert (reading.prism, reading.slope_distance_m) == (1, 12.5)
    assert (reading.horizontal_angle_rad, reading.zenith_angle_rad) == (1.0, 1.5)
    assert (reading.status, reading.raw_status, reading.instrument_time_ns) == (Status.LOW_ACCURACY, 1284, 7)


async def test_commands_are_sent_in_bridge_format() -> None:
    """With consecutive ids."""
    instrument, program, _ = await tracking()
    await instrument.track(2, Direction(horizontal_angle_rad=1.0, zenith_angle_rad=1.5, spread_rad=0.1))
    await instrument.set_atmosphere(Atmosphere(temperature_c=12.0, pressure_hpa=950.0))
    await instrument.direct()
    towards = {"horizontal_angle_rad": 1.0, "zenith_angle_rad": 1.5, "spread_rad": 0.1}
    assert program.commands == [
        {"type": "track", "id": 1, "prism": 1, "towards": None},
        {"type": "track", "id": 2, "prism": 2, "towards": towards},
        {"type": "atmosphere", "id": 3, "temperature_c": 12.0, "pressure_hpa": 950.0},
        {"type": "direct", "id": 4},
    ]


async def test_refused_command_changes_nothing() -> None:
    """The program continues to track its prism."""
    instrument, program, _ = await tracking()
    program.on_command = lambda command: program.done(command, "there is no prism 9\x1b[31m")
    with pytest.raises(InstrumentRefusedError, match=r"bridge: track: there is no prism 9 \[31m"):
        await instrument.track(9)
    program.measure()
    assert (await instrument.read()).prism == 1


async def test_program_without_commands_tracks() -> None:
    """It measures what the operator has set up; everything else is refused, and nothing is sent."""
    instrument, program, _ = await tracking(HELLO)
    program.measure()
    assert (await instrument.read()).prism == 1
    for refused in (
        instrument.direct(),
        instrument.measure(),
        instrument.set_atmosphere(Atmosphere(temperature_c=12.0, pressure_hpa=950.0)),
    ):
        with pytest.raises(InstrumentRefusedError):
            await refused
    assert program.commands == []


async def test_single_measurement() -> None:
    """The response to the command, with or without a target, or an error."""
    instrument, program, _ = await tracking()
    with pytest.raises(InstrumentRefusedError, match="call direct first"):
        await instrument.measure()
    await instrument.direct()
    single = measured(20.0) | {"type": "shot"}
    program.on_command = lambda command: program.print_lines(single | {"id": command["id"]})
    reading = await instrument.measure()
    assert (reading.prism, reading.slope_distance_m, reading.at_ns) == (None, 20.0, CLOCK.monotonic_ns())
    program.on_command = lambda command: program.print_lines(
        {"type": "shot", "id": command["id"], "status": "no_target"}
    )
    reading = await instrument.measure()
    assert (reading.status, reading.slope_distance_m) == (Status.NO_TARGET, None)
    for response in (
        single | {"slope_distance_m": -1.0},
        {"type": "done"},
        {"type": "done", "error": "no foil"},
    ):
        program.on_command = lambda command, response=response: program.print_lines(
            response | {"id": command["id"]}
        )  # type: ignore[misc]
        with pytest.raises(InstrumentRefusedError, match=r"expected metres|contains no measurement|no foil"):
            await instrument.measure()


async def test_readings_of_old_prism_are_dropped_after_change() -> None:
    """Lines before the response belong to the old prism; one that names another prism is rejected."""
    instrument, program, _ = await tracking()
    program.measure(1.0)

    def response(command: dict[str, Any]) -> None:
        program.print_lines(
            program.measurement(2.0), {"type": "done", "id": command["id"]}, program.measurement(3.0)
        )

    program.on_command = response
    await asyncio.sleep(0.4)
    await instrument.track(3)
    await asyncio.sleep(0.4)
    program.measure(4.0, prism=1)
    program.measure(5.0, prism=3)
    assert [(reading.prism, reading.slope_distance_m) for reading in await queued(instrument)] == [(3, 5.0)]


async def test_repeated_measurement_is_dropped() -> None:
    """By time and values, also after a restart of the program."""
    instrument, program, start = await tracking()
    line = program.measurement(instrument_time_ns=1000)
    program.print_lines(line, line)
    program.measure(host_time_ns=CLOCK.monotonic_ns(), instrument_time_ns=1000)
    program.exit()
    assert len(await instrument_readings(instrument)) == 1
    await instrument.connect()
    await instrument.track(1)
    start.programs[1].print_lines(line)
    assert await queued(instrument) == []


async def test_coarse_instrument_time_loses_no_measurement() -> None:
    """Different values identify a new measurement."""
    instrument, program, _ = await tracking()
    for number in range(10):
        await asyncio.sleep(0.4)
        program.measure(1.0 + number, instrument_time_ns=CLOCK.monotonic_ns() // 10**9 * 10**9)
    assert len(await queued(instrument)) == 10


async def instrument_readings(instrument: BridgeInstrument) -> list[Reading]:
    """Read until the program has failed."""
    readings = []
    try:
        while True:
            readings.append(await instrument.read())
    except InstrumentError:
        return readings


async def test_queued_readings_precede_error() -> None:
    """They are kept even across a new connection."""
    instrument, program, _ = await tracking()
    program.measure(1.0)
    await asyncio.sleep(0.4)
    program.measure(2.0)
    program.exit("exit status 3: no license")
    assert (await instrument.read()).slope_distance_m == 1.0
    await instrument.connect()
    await instrument.track(1)
    assert (await instrument.read()).slope_distance_m == 2.0


async def test_exit_is_reported_with_reason() -> None:
    """The error names the program, how it ended, and its last error message."""
    instrument, program, _ = await tracking()
    program.exit("exit status 3: no license")
    with pytest.raises(InstrumentError, match=r"bridge: the program has ended \(exit status 3: no license\)"):
        await instrument.read()
    assert "no license" in instrument.condition.problem


async def test_silence_while_tracking_is_a_stall() -> None:
    """The program is killed after stall_timeout_s; usable lines restart the timeout, garbage does not."""
    instrument, program, _ = await tracking()
    start_ns = CLOCK.monotonic_ns()

    async def talk() -> None:
        await asyncio.sleep(4.0)
        program.print_lines({"type": "status", "activity": "looking around"})
        await asyncio.sleep(4.0)
        program.print_lines(b"garbage")

    talking = asyncio.create_task(talk())
    with pytest.raises(
        InstrumentError, match=r"has printed nothing usable for 5 s \(a line of the program was rejected"
    ):
        await instrument.read()
    assert CLOCK.monotonic_ns() - start_ns == 9_000_000_000
    assert program.ended
    await talking


async def test_silence_in_direct_mode_is_no_stall() -> None:
    """The operator aims."""
    instrument, program, _ = await tracking()
    await instrument.direct()
    await asyncio.sleep(3600.0)
    await instrument.check()
    await instrument.track(1)
    program.measure()
    await instrument.read()


async def test_exit_in_direct_mode_is_detected() -> None:
    """By the periodic check."""
    instrument, program, _ = await tracking()
    await instrument.direct()
    program.exit("exit status 3")
    with pytest.raises(InstrumentError, match="has ended"):
        await instrument.check()


async def test_missing_response_is_a_stall() -> None:
    """After 30 s, whatever else the program prints."""
    instrument, program, _ = await tracking()
    program.on_command = lambda _: program.print_lines({"type": "done", "id": 77})
    start_ns = CLOCK.monotonic_ns()
    with pytest.raises(InstrumentError, match="does not respond to direct"):
        await instrument.direct()
    assert CLOCK.monotonic_ns() - start_ns == 30_000_000_000
    assert program.ended


async def test_status_lines_extend_hello_timeout() -> None:
    """A silent program has 30 s."""
    start = FakeStart(CLOCK)
    instrument = BridgeInstrument(CONFIG, CLOCK, start)
    connecting = asyncio.create_task(instrument.connect())
    for _ in range(10):
        await asyncio.sleep(20.0)
        start.programs[0].print_lines({"type": "status", "problem": "switch the instrument on"})
        assert instrument.condition.problem == "switch the instrument on"
    start.programs[0].print_lines(HELLO)
    await connecting
    start_ns = CLOCK.monotonic_ns()
    with pytest.raises(InstrumentError, match="has not sent hello"):
        await instrument.connect()
    assert CLOCK.monotonic_ns() - start_ns == 30_000_000_000


async def test_other_version_is_rejected() -> None:
    """The error names both, and the program is killed."""
    start = FakeStart(CLOCK, {"type": "hello", "bridge": 2})
    instrument = BridgeInstrument(CONFIG, CLOCK, start)
    with pytest.raises(
        InstrumentError, match=r"prints version 2 of the bridge's line format; this client supports version 1"
    ):
        await instrument.connect()
    assert start.programs[0].ended


async def test_second_hello_ends_session() -> None:
    """A wrapper has restarted its program, which knows no commands."""
    instrument, program, _ = await tracking()
    program.print_lines(FULL)
    with pytest.raises(InstrumentError, match="second hello"):
        await instrument.read()


@pytest.mark.parametrize(
    "wrong",
    [
        b"Vendor SDK 3.2, Copyright",
        b"\xff\xfe\x00",
        b"[" * 5000,
        b'{"type":"measurement"' + b" " * 100_000 + b"}",
        b'{"type":"measurement","status":"ok","horizontal_angle_rad":NaN}',
        {"slope_distance_m": 1e400},
        {"slope_distance_m": -1},
        {"slope_distance_m": 0},
        {"slope_distance_m": 12_345_678},
        {"slope_distance_m": None},
        {"slope_distance_m": "12"},
        {"horizontal_angle_rad": 200.0},
        {"zenith_angle_rad": -0.1},
        {"status": "fine"},
        {"status": None},
        {"raw_status": 1 << 40},
        {"host_time_ns": None},
        {"host_time_ns": -1},
        {"host_time_ns": 1.5e9},
        {"host_time_ns": 10**400},
        {"host_time_ns": 1_700_000_000_000_000_000},
        {"host_time_ns": 60_000_000_001},
        {"host_time_ns": 49_000_000_000},
        {"prism": 2},
    ],
)
async def test_invalid_line_is_rejected(wrong: bytes | dict[str, Any]) -> None:
    """Log and condition report it, and the next valid line is read."""
    with capture_logs() as logs:
        instrument, program, _ = await tracking()
        program.print_lines(wrong if isinstance(wrong, bytes) else program.measurement() | wrong)
        assert await queued(instrument) == []
        assert "was rejected" in instrument.condition.problem
        await asyncio.sleep(0.4)
        program.measure()
        assert len(await queued(instrument)) == 1
    assert [entry["event"] for entry in logs] == ["bridge_line_rejected"]
    assert len(logs[0]["line"]) <= 200
    assert instrument.condition.problem == ""


async def test_rejected_lines_are_logged_once_a_minute() -> None:
    """With their number."""
    with capture_logs() as logs:
        _, program, _ = await tracking()
        for _ in range(130):
            await asyncio.sleep(1.0)
            program.print_lines(b"garbage")
    assert [entry["rejected"] for entry in logs] == [1, 61, 121]


@pytest.mark.parametrize("flood", [b"{}\n" * 2000, b"x" * 2_000_000, b"\n" * 3000])
async def test_excessive_output_kills_program(flood: bytes) -> None:
    """Many lines, or one without end."""
    instrument, program, _ = await tracking()
    program.print(flood)
    assert program.ended
    with pytest.raises(InstrumentError, match="more than 1000 lines in a second"):
        await instrument.read()


async def test_garbage_between_lines_is_ignored() -> None:
    """Random bytes in random pieces: each valid line is read once."""
    generator = random.Random(1)  # noqa: S311 (no secrets)
    instrument, program, _ = await tracking()
    count = 200
    for number in range(count):
        await asyncio.sleep(0.4)
        good = b"\n" + repr(program.measurement(1.0 + number)).replace("'", '"').encode() + b"\n"
        data = generator.randbytes(generator.randrange(300)) + good + generator.randbytes(20) + b"\n"
        while data:
            cut = generator.randrange(1, 100)
            program.print(data[:cut])
            data = data[cut:]
    readings = await queued(instrument)
    assert [reading.slope_distance_m for reading in readings] == [1.0 + number for number in range(count)]


async def test_missing_target_is_reported_twice_a_second_at_most() -> None:
    """Every change is reported, and the first one after a measurement."""
    instrument, program, _ = await tracking()
    for _ in range(100):
        await asyncio.sleep(0.05)
        program.print_lines({"type": "measurement", "status": "no_target"})
    assert len(await queued(instrument)) == 10
    for status in ("no_target", "angle_only", "no_target"):
        program.measure()
        await asyncio.sleep(0.01)
        program.print_lines({"type": "measurement", "status": status})
    assert len(await queued(instrument)) == 6


async def test_arrival_is_timestamp_of_single_lines() -> None:
    """Lines that arrive together are rejected."""
    instrument, program, _ = await tracking(HELLO | {"stamps": "arrival"})
    program.print_lines(measured(1.0))
    at_ns = CLOCK.monotonic_ns()
    await asyncio.sleep(0.4)
    program.print_lines(measured(2.0), measured(3.0))
    assert [(reading.slope_distance_m, reading.at_ns) for reading in await queued(instrument)] == [
        (1.0, at_ns)
    ]
    assert "flush" in instrument.condition.problem


async def test_instrument_time_is_mapped_to_host_clock() -> None:
    """The jitter of the arrivals does not matter; the first lines wait for the clock fit."""
    generator = random.Random(2)  # noqa: S311 (no secrets)
    instrument, program, _ = await tracking(HELLO | {"stamps": "instrument", "clock": "power-on"})
    true_ns, readings = {}, []
    for number in range(300):
        await asyncio.sleep(0.4)
        made_ns = CLOCK.monotonic_ns()
        time_ns = 3_600_000_000_000 + round(made_ns * (1 + 20e-6))
        true_ns[time_ns] = made_ns
        await asyncio.sleep(generator.expovariate(1 / 0.005) if number != 100 else 1.0)
        program.print_lines(measured(instrument_time_ns=time_ns))
        readings += await queued(instrument)
        if number == 3:
            assert readings == []
    assert [reading.instrument_time_ns for reading in readings] == list(true_ns)
    errors_ms = [(reading.at_ns - true_ns[reading.instrument_time_ns or 0]) / 1e6 for reading in readings]
    assert max(map(abs, errors_ms)) < 4.0
    assert max(map(abs, errors_ms[20:])) < 1.5
    assert all(reading.sigma_ns > 0 for reading in readings)


async def test_power_cycle_resets_clock_fit() -> None:
    """No reading has a wrong time."""
    instrument, program, _ = await tracking(HELLO | {"stamps": "instrument"})
    switched_on_ns, readings, true_ns = 0, [], {}
    for number in range(60):
        await asyncio.sleep(0.4)
        if number == 30:
            switched_on_ns = CLOCK.monotonic_ns() - 1
        time_ns = CLOCK.monotonic_ns() - switched_on_ns
        true_ns[time_ns] = CLOCK.monotonic_ns()
        program.print_lines(measured(instrument_time_ns=time_ns))
        readings += await queued(instrument)
    assert len(readings) > 55
    assert all(abs(reading.at_ns - true_ns[reading.instrument_time_ns or 0]) < 1e6 for reading in readings)


async def test_condition_and_record_follow_program() -> None:
    """The record changes with the settings only."""
    assert BridgeInstrument(CONFIG, CLOCK).record is None
    config = CONFIG.model_copy(update={"latency_ms": 3.0})
    instrument, program, _ = await tracking(HELLO | {"model": "S7"}, config)
    before = instrument.record
    assert (instrument.condition.activity, instrument.condition.problem) == ("tracking", "")
    program.print_lines({"type": "status", "problem": "not level", "battery_percent": 30})
    assert instrument.record == before
    assert (instrument.condition.problem, instrument.condition.battery_percent) == ("not level", 30)
    program.print_lines({"type": "settings", "prism_type": "360", "prism_constant_m": 0.002})
    record = instrument.record
    assert record is not None
    assert (record.make, record.model, record.prism_type, record.latency_ns) == (
        "Fake",
        "S7",
        "360",
        3_000_000,
    )
    assert record.prism_constant_m == 0.002


async def test_cancelled_read_loses_no_reading() -> None:
    """The next call returns it."""
    instrument, program, _ = await tracking()
    readings: list[Reading] = []
    for number in range(40):
        program.measure(1.0 + number)
        await asyncio.sleep(0.1)
        readings += await queued(instrument)
    assert len(readings) == 40


async def test_crashing_program_is_restarted_with_delay() -> None:
    """About once a second, for ever; logged once."""
    start = FakeStart(CLOCK)
    instrument = BridgeInstrument(CONFIG, CLOCK, start)
    supervisor = InstrumentSupervisor(
        instrument,
        ClientSession(1, 1),
        CLOCK,
        on_reading=lambda _: None,
        on_record=lambda _: None,
        on_result=lambda _: None,
    )

    async def end_each() -> None:
        while True:
            await asyncio.sleep(0.01)
            for program in start.programs:
                if not program.ended:
                    program.exit("exit status 1: no licence")

    with capture_logs() as logs:
        tasks = [asyncio.create_task(supervisor.run()), asyncio.create_task(end_each())]
        await asyncio.sleep(60.0)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    assert 55 <= len(start.programs) <= 65
    assert [entry["event"] for entry in logs] == ["instrument_lost"]
    assert "no licence" in supervisor.condition.problem


@pytest.mark.slow
async def test_random_exits_lose_and_repeat_no_measurement() -> None:
    """Each run starts with the last measurement of the one before."""
    generator = random.Random(3)  # noqa: S311 (no secrets)
    start = FakeStart(CLOCK, FULL)
    instrument = BridgeInstrument(CONFIG, CLOCK, start)
    readings: list[Reading] = []
    supervisor = InstrumentSupervisor(
        instrument,
        ClientSession(1, 1),
        CLOCK,
        on_reading=readings.append,
        on_record=lambda _: None,
        on_result=lambda _: None,
    )
    running = asyncio.create_task(supervisor.run())
    printed: list[float] = []
    last: dict[str, Any] | None = None
    with capture_logs():
        for number in range(5000):
            await asyncio.sleep(0.05)
            program = start.programs[-1]
            tracks = any(command["type"] == "track" for command in program.commands)
            if program.ended or not tracks:
                continue
            if last is not None:
                program.print_lines(last)
            last = program.measurement(1.0 + number)
            program.print_lines(last)
            printed.append(1.0 + number)
            if generator.random() < 0.05:
                program.exit()
        await asyncio.sleep(3.0)
        running.cancel()
        await asyncio.wait([running])
    assert len(start.programs) > 50
    assert [reading.slope_distance_m for reading in readings] == printed
