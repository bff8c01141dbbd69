"""The C++ header: compiled without warnings, and its example against a master, a relay and rubbish."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import shutil
import socket
import subprocess
import time
from asyncio.subprocess import PIPE
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING
from unittest.mock import Mock

import pytest
from harness.files.records import EVENT, HELLO, NO_POSE, POSE, SETUP, STATUS
from harness.files.stream_lines import lines, serving
from harness.missions.processes import ROOT, TIMEOUT_S, Program, free_port
from harness.readers.network import PERIOD_NS, TSGT, Master

from tsgt.client.records import monotonic_ns
from tsgt.client.source import read_key_file
from tsgt.radio.key_file import write_key
from tsgt.recording import encode_line
from tsgt.relay.admission import MAX_READERS
from tsgt.relay.buffer import LineBuffer
from tsgt.relay.server import RelayServer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tsgt.recording import PoseRecord, StatusRecord

FOLDER = ROOT / "integrations" / "cpp"
GXX = shutil.which("g++") or ""
pytestmark = pytest.mark.skipif(not GXX, reason="g++ is not installed")

AWKWARD = replace(
    POSE,
    kind="predicted",
    stamp_ns=9_007_199_254_740_993,  # beyond what a double can hold
    position_m=(0.1 + 0.2, -5e-324, 1.7976931348623157e308),
    orientation_xyzw=(1 / 3, -0.0, 123456.7, 1e-7),
)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the example."""
    path = tmp_path_factory.mktemp("cpp") / "print_poses"
    warnings = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
    # A signed overflow ends the program; so it does without the sanitizer's library.
    undefined = ("-fsanitize=undefined", "-fsanitize-undefined-trap-on-error")
    command = [
        GXX, "-std=c++17", "-O1", *warnings, *undefined, "-o", str(path), str(FOLDER / "print_poses.cpp"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return path


def printing(program: Path, folder: Path, *arguments: str) -> Program:
    """Run the example."""
    return Program([program, *arguments], folder, "example")


def test_numbers_arrive_to_the_last_bit(program: Path, tmp_path: Path) -> None:
    """Times as 64-bit integers, positions and rotations as the same doubles."""
    sent = (
        HELLO,
        SETUP,
        b'{"type":"weather","x":[{"y":"\\u00e9\\ud83d\\ude00"}]}',
        AWKWARD,
    )
    with serving(tmp_path / "s", lines(*sent)), printing(program, tmp_path, str(tmp_path / "s")) as example:
        example.wait_for_lines(2)
        hello, pose = example.output.read_text().splitlines()[:2]
    assert hello == f"hello {HELLO.version}"
    numbers, age = pose.split("; ")
    kind, stamp, *rest = numbers.split()
    assert (kind, int(stamp)) == ("pose", AWKWARD.stamp_ns)
    sent_numbers = json.loads(encode_line(AWKWARD))
    assert [float(number).hex() for number in rest] == [
        float(number).hex() for number in (*sent_numbers["position_m"], *sent_numbers["orientation_xyzw"])
    ]
    assert age.startswith("age 0.0")


LATEST = """
#include <cinttypes>
#include <cstdio>
#include "tsgt_stream.hpp"
int main(int, char** argv) {
  tsgt::Stream stream(argv[1]);
  std::int64_t last = 0;
  for (int poses = 0; poses < 20 || last != -1;) {
    const auto* pose = stream.latest(0.3);
    const std::int64_t stamp = pose == nullptr ? -1 : pose->stamp_ns;
    if (stamp != last) {
      std::printf("%" PRId64 "\\n", stamp);
      std::fflush(stdout);
      poses += pose != nullptr;
    }
    last = stamp;
    poll(nullptr, 0, 5);
  }
}
"""


def test_latest_pose_becomes_stale(tmp_path: Path) -> None:
    """A control loop gets each new pose, and none once the master is silent."""
    (tmp_path / "latest.cpp").write_text(LATEST)
    command = [
        GXX,
        "-std=c++17",
        "-I",
        str(FOLDER),
        "-o",
        str(tmp_path / "latest"),
        str(tmp_path / "latest.cpp"),
    ]
    subprocess.run(command, check=True)
    with Program([tmp_path / "latest", tmp_path / "s"], tmp_path, "latest") as program:
        with Master(tmp_path / "s").running() as master:
            program.wait_for_lines(30)
        assert program.ended() == 0
    first, *printed, last = map(int, program.output.read_text().split())
    assert (first, last) == (-1, -1)
    # On a busy machine some are too late, or overtaken.
    poses = [stamp for stamp in printed if stamp != -1]
    steps = [after - before for before, after in itertools.pairwise(poses)]
    assert all(step > 0 and step % PERIOD_NS == 0 for step in steps)
    assert steps.count(PERIOD_NS) > len(steps) // 2
    assert poses[-1] <= master.first_ns + (master.sent - 1) * PERIOD_NS


LATE = """
#include <cinttypes>
#include <cstdio>
#include "tsgt_stream.hpp"

// A computer with two addresses, at the first of which nobody listens.
extern "C" int getaddrinfo(const char*, const char* port, const addrinfo*, addrinfo** found) {
  static sockaddr_in addresses[2];
  static addrinfo entries[2];
  for (int i = 0; i < 2; ++i) {
    addresses[i].sin_family = AF_INET;
    addresses[i].sin_port = htons(static_cast<std::uint16_t>(std::atoi(port)));
    addresses[i].sin_addr.s_addr = htonl(i == 0 ? 0x7f000002 : INADDR_LOOPBACK);
    entries[i].ai_family = AF_INET;
    entries[i].ai_addr = reinterpret_cast<sockaddr*>(&addresses[i]);
    entries[i].ai_addrlen = sizeof(sockaddr_in);
    entries[i].ai_next = i == 0 ? &entries[1] : nullptr;
  }
  *found = entries;
  return 0;
}
extern "C" void freeaddrinfo(addrinfo*) noexcept {}

int main(int argc, char** argv) {
  tsgt::Stream stream(argv[1], argc > 2 ? argv[2] : "");
  stream.latest(0.2);
  std::puts("connected");
  std::fflush(stdout);
  std::getchar();
  std::string problem;
  while (true) {
    const auto record = stream.next(std::chrono::milliseconds(5));
    if (stream.problem() != problem) std::puts((problem = stream.problem()).c_str());
    if (record)
      if (const auto* pose = std::get_if<tsgt::Pose>(&*record)) std::printf("%" PRId64 " %.3f\\n", pose->stamp_ns, pose->age_s());
    std::fflush(stdout);
  }
}
"""


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile a program that connects, and reads when it gets a character."""
    folder = tmp_path_factory.mktemp("late")
    (folder / "late.cpp").write_text(LATE)
    subprocess.run(
        [GXX, "-std=c++17", "-I", str(FOLDER), "-o", str(folder / "late"), str(folder / "late.cpp")],
        check=True,
    )
    return folder / "late"


@contextmanager
def begun(*command: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run a program that has connected and waits for a character."""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "connected\n"
            yield program
        finally:
            program.kill()


def read_now(program: subprocess.Popen[str], lines_: int) -> list[str]:
    """Let the program read; returns the first lines that it prints."""
    assert program.stdin is not None
    assert program.stdout is not None
    program.stdin.write("\n")
    program.stdin.flush()
    return [program.stdout.readline().rstrip("\n") for _ in range(lines_)]


def test_backlog_after_the_connection_is_not_taken_for_new(late: Path, tmp_path: Path) -> None:
    """A program that connects and is busy: the newest of the lines that wait dates the others."""
    poses = [replace(AWKWARD, stamp_ns=POSE.stamp_ns + number * PERIOD_NS) for number in range(61)]
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        with begun(late, tmp_path / "s") as program, listener.accept()[0] as connection:
            time.sleep(0.2)  # the header has the clock of the computer; what is read sooner counts as new
            connection.sendall(lines(HELLO, *poses))
            printed = [line.split() for line in read_now(program, len(poses))]
    assert [int(stamp) for stamp, _ in printed] == [pose.stamp_ns for pose in poses]
    ages_s = [float(age) for _, age in printed]
    assert ages_s[0] >= 3.0
    assert ages_s[30] >= 1.5


def test_smoothed_pose_before_all_else_has_its_age(late: Path, tmp_path: Path) -> None:
    """Its arrival says nothing of its epoch, so it waits for a line that does."""
    smoothed = replace(POSE, kind="smoothed")
    predicted = replace(POSE, kind="predicted", stamp_ns=POSE.stamp_ns + 3_000_000_000)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        with begun(late, tmp_path / "s") as program, listener.accept()[0] as connection:
            connection.sendall(lines(HELLO, smoothed, predicted))
            stamp, age = read_now(program, 1)[0].split()
    assert int(stamp) == smoothed.stamp_ns
    assert float(age) >= 3.0


def test_all_addresses_are_tried_and_another_version_is_no_end(late: Path, tmp_path: Path) -> None:
    """Nobody has proved anything with the first line, so the next attempt may find the relay."""
    write_key(tmp_path / "relay.key")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(TIMEOUT_S)
        address = f"relay://robot:{listener.getsockname()[1]}"
        with begun(late, address, tmp_path / "relay.key") as program:
            read_now(program, 0)
            for _ in range(2):
                with listener.accept()[0] as connection:
                    connection.sendall(b"tsgt-relay 2 " + b"11" * 32 + b"\n")
                    assert connection.recv(1) == b""
            program.kill()
            assert program.stdout is not None
            reasons = {line.removeprefix(f"{address}: ").rstrip() for line in program.stdout}
    assert reasons == {"Connection refused", "the relay has another protocol version than 1"}


def test_gaps_events_and_reasons_are_told(program: Path, tmp_path: Path) -> None:
    """Also unusable lines, and a restart of the master."""
    first = lines(HELLO, NO_POSE, EVENT, b'{"type":"pose"}', b'{"type":')
    with (
        serving(tmp_path / "s", first, lines(HELLO)),
        printing(program, tmp_path, str(tmp_path / "s")) as example,
    ):
        example.wait_for_lines(8)
        found = example.output.read_text().splitlines()
    assert [line.split("; ")[0] for line in found] == [
        f"hello {HELLO.version}",
        f"pose {NO_POSE.stamp_ns} invalid: outage",
        f"event {EVENT.stamp_ns} lines_lost: lost 7 lines",
        "gap 7 this reader was too slow for the master",
        "gap 1 a line cannot be used: expected a string",
        "gap 1 a line cannot be used: not JSON",
        "gap ? the connection to the master was lost",
        f"hello {HELLO.version}",
    ]


LARGEST = 2**63 - 1


@pytest.mark.parametrize("stamps", [(-LARGEST - 1,), (-LARGEST, LARGEST), (-LARGEST, 0, LARGEST, -LARGEST)])
def test_absurd_times_are_no_overflow(program: Path, tmp_path: Path, stamps: tuple[int, ...]) -> None:
    """What does not fit is a gap, as in Python; a time that fits only by a hair leaves the program running."""
    now_ns = time.time_ns()
    unusable = 2 if stamps == (-LARGEST - 1,) else 0
    smoothed = replace(POSE, kind="smoothed")  # dated by the lines before, and not printed
    absurd = [_stamped(record, stamp) for stamp in stamps for record in (STATUS, smoothed)]
    now = [_stamped(record, now_ns) for record in (STATUS, replace(POSE, kind="predicted"))]
    sent = (HELLO, *absurd, HELLO, *now)
    with serving(tmp_path / "s", lines(*sent)), printing(program, tmp_path, str(tmp_path / "s")) as example:
        example.wait_for_lines(3 + unusable)
        found = example.output.read_text().splitlines()
    assert found[1 : 1 + unusable] == unusable * ["gap 1 a line cannot be used: a time beyond 64 bits"]
    last = found[2 + unusable]
    assert last.startswith(f"pose {now_ns} ")
    assert float(last.split("age ")[1].split()[0]) < TIMEOUT_S


def _stamped(record: PoseRecord | StatusRecord, stamp_ns: int) -> bytes:
    """Return a line with a time that our own records may not have."""
    return re.sub(rb'"stamp_ns":\d+', b'"stamp_ns":%d' % stamp_ns, encode_line(record), count=1)


@pytest.mark.parametrize("number", [b"010", b"-01", b".5", b"1.", b"1e", b"-", b"+1", b"1-1"])
def test_what_is_no_number_is_a_gap(program: Path, tmp_path: Path, number: bytes) -> None:
    """As in Python."""
    line = b'{"type":"weather","x":[0,-0.5e+1,1E5,%s]}' % number
    good = b'{"type":"weather","x":[0,-0,10,-0.5e+1,1E5,-12]}'
    with (
        serving(tmp_path / "s", lines(HELLO, good, line)),
        printing(program, tmp_path, str(tmp_path / "s")) as example,
    ):
        example.wait_for_lines(2)
        found = example.output.read_text().splitlines()
    assert found[1] == "gap 1 a line cannot be used: not JSON"


@pytest.mark.parametrize(
    "number",
    [b"9223372036854775808", b"18446744073709551615", b"-9223372036854775809", b"1e-400", b"-1e-400"],
)
def test_number_beyond_its_type_costs_no_pose(program: Path, tmp_path: Path, number: bytes) -> None:
    """It becomes the nearest double, also where the program does not use it."""
    pose = encode_line(AWKWARD)[:-1] + b',"later":%s}' % number
    with (
        serving(tmp_path / "s", lines(HELLO, pose)),
        printing(program, tmp_path, str(tmp_path / "s")) as example,
    ):
        example.wait_for_lines(2)
        found = example.output.read_text().splitlines()
    assert found[1].startswith(f"pose {AWKWARD.stamp_ns} ")


@pytest.mark.parametrize("number", [b"1e400", b"-1e400", 400 * b"9"])
def test_number_that_no_double_holds_is_a_gap(program: Path, tmp_path: Path, number: bytes) -> None:
    """All numbers are finite."""
    line = b'{"type":"weather","x":%s}' % number
    with (
        serving(tmp_path / "s", lines(HELLO, line)),
        printing(program, tmp_path, str(tmp_path / "s")) as example,
    ):
        example.wait_for_lines(2)
        found = example.output.read_text().splitlines()
    assert found[1] == "gap 1 a line cannot be used: not JSON"


KINDS = """
#include <cstdio>
#include "tsgt_stream.hpp"
int main(int, char** argv) {
  tsgt::Stream stream(argv[1]);
  std::string last;
  while (last != "interpolated") {
    const auto* pose = stream.latest(1e9);
    if (pose != nullptr && pose->kind != last) std::puts((last = pose->kind).c_str());
    poll(nullptr, 0, 5);
  }
}
"""


def test_latest_pose_is_of_a_known_kind(tmp_path: Path) -> None:
    """What a later version of the master adds may be anything, such as a pose of the future."""
    (tmp_path / "kinds.cpp").write_text(KINDS)
    command = [
        GXX, "-std=c++17", "-I", str(FOLDER), "-o", str(tmp_path / "kinds"), str(tmp_path / "kinds.cpp"),
    ]  # fmt: skip
    subprocess.run(command, check=True)
    forecast = encode_line(AWKWARD).replace(b'"predicted"', b'"forecast"')
    smoothed, interpolated = replace(AWKWARD, kind="smoothed"), replace(AWKWARD, kind="interpolated")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        with Program([tmp_path / "kinds", tmp_path / "s"], tmp_path, "kinds") as program:
            connection, _ = listener.accept()
            with connection:
                for sent in ((HELLO, AWKWARD), (forecast, smoothed), (interpolated,)):
                    connection.sendall(lines(*sent))
                    time.sleep(0.3)
            assert program.ended() == 0
    assert program.output.read_text().split() == ["predicted", "interpolated"]


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b'{"type":"hello","protocol":2}\n', "another protocol version"),
        (b"220 mail\n", "not a stream of tsgt"),
    ],
)
def test_other_streams_are_errors(program: Path, tmp_path: Path, data: bytes, error: str) -> None:
    """Another attempt would not help."""
    with serving(tmp_path / "s", data):
        done = subprocess.run(
            [program, tmp_path / "s"], capture_output=True, text=True, check=False, timeout=TIMEOUT_S
        )
    assert done.returncode == 1
    assert error in done.stderr


def test_tls_is_refused_with_the_way_to_encrypt(program: Path) -> None:
    """A relay with a certificate is not taken for a socket's path."""
    command = [str(program), "relays://127.0.0.1", "relay.key"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)
    assert (done.returncode, done.stdout) == (1, "")
    assert "for TLS use `ssh -L` here" in done.stderr


@contextmanager
def relay(folder: Path, port: int) -> Iterator[str]:
    """Run a relay; gives its address once it has connected to the master."""
    command = [
        *TSGT, "relay", "--socket", str(folder / "s"), "--key", str(folder / "relay.key"), "--listen", f"127.0.0.1:{port}",
    ]  # fmt: skip
    with Program(command, folder, "relay") as running:
        running.wait_for("relay_source_connected")
        yield f"relay://127.0.0.1:{port}"


def test_relay_is_read_and_its_restart_told(program: Path, tmp_path: Path) -> None:
    """Handshake and tags are right; after the relay's restart it goes on with a gap."""
    write_key(tmp_path / "relay.key")
    address = f"relay://127.0.0.1:{(port := free_port())}"
    with (
        Master(tmp_path / "s").running(),
        printing(program, tmp_path, address, str(tmp_path / "relay.key")) as example,
    ):
        for poses in (20, 40):
            with relay(tmp_path, port):
                example.wait_for_lines(poses)
    kinds = [line.split()[0] for line in example.output.read_text().splitlines()]
    assert kinds.count("hello") == 2
    assert kinds.count("gap") >= 1
    assert kinds[0] == "hello"
    assert kinds[-1] == "pose"


def test_wrong_key_gets_nothing(program: Path, tmp_path: Path) -> None:
    """And the program ends with the reason."""
    write_key(tmp_path / "relay.key")
    write_key(tmp_path / "other.key")
    with Master(tmp_path / "s").running(), relay(tmp_path, free_port()) as address:
        command = [str(program), address, str(tmp_path / "other.key")]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)
    assert (done.returncode, done.stdout) == (1, "")
    assert "the relay has another key" in done.stderr


def test_reader_waits_for_a_place_at_a_full_relay(program: Path, tmp_path: Path) -> None:
    """It is told so, and not that its key is wrong; once there is a place it has the greeting and every line since."""
    write_key(key := tmp_path / "relay.key")
    buffer = LineBuffer("ab" * 16, read_key_file(key), max_bytes=1 << 20, max_age_ns=10**12)

    async def main() -> str:
        async with RelayServer(
            "127.0.0.1", 0, read_key_file(key), buffer, tls=None, now_ns=monotonic_ns
        ) as server:
            server.line(encode_line(HELLO))
            server.readers |= (crowd := {Mock() for _ in range(MAX_READERS)})
            command = (str(program), f"relay://127.0.0.1:{server.port}", str(key))
            example = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=PIPE)
            assert example.stdout is not None
            assert example.stderr is not None
            assert b"hello" in await asyncio.wait_for(example.stdout.readline(), TIMEOUT_S)
            for number in range(3):
                server.line(encode_line(replace(AWKWARD, stamp_ns=AWKWARD.stamp_ns + number * PERIOD_NS)))
                await asyncio.sleep(0.2)  # some attempts
            server.readers -= crowd
            for number in range(3):
                line = await asyncio.wait_for(example.stdout.readline(), TIMEOUT_S)
                assert int(line.split()[1]) == AWKWARD.stamp_ns + number * PERIOD_NS
            example.kill()
            return (await example.communicate())[1].decode()

    problems = asyncio.run(main()).splitlines()
    assert len(problems) == 1
    assert problems[0].endswith("the relay has too many readers")
