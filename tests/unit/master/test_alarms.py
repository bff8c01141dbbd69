"""Alarms: which events leave the machine, how often, and what a web server may do."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import pytest
from harness.files.records import EVENT
from structlog.testing import capture_logs

from tsgt.config import AlarmsConfig
from tsgt.master import alarms as alarms_module
from tsgt.master.alarms import MAX_WAITING, RETRY_DELAYS_S, Alarm, AlarmLimiter, Alarms
from tsgt.master.webhook import post
from tsgt.simulation.kernel import VirtualClock

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

SECOND = 1_000_000_000
LOST = replace(EVENT, event="station_lost", message="station 2 lost", station=2, count=None)
EXITED = replace(EVENT, event="geofence_exited", message="geofence yard exited: 2 m beyond", count=None)


def limiter() -> AlarmLimiter:
    """Return a limiter of two events, to one per 60 s."""
    return AlarmLimiter(["station_lost", "geofence_exited"], 60 * SECOND)


def test_only_alarms_pass() -> None:
    """Other events stay on the stream."""
    limit = limiter()
    assert limit.take(EVENT, 0) == []
    assert limit.take(LOST, 0) == [Alarm(LOST)]
    assert limit.next_deadline_ns() is None


def test_last_of_many_passes_at_the_end_of_the_interval() -> None:
    """With the number of those that never pass; then the next interval begins."""
    limit = limiter()
    assert limit.take(LOST, 0) == [Alarm(LOST)]
    flapping = [replace(LOST, stamp_ns=second * SECOND) for second in (10, 20, 30)]
    assert [limit.take(event, event.stamp_ns) for event in flapping] == [[], [], []]
    assert limit.next_deadline_ns() == 60 * SECOND
    assert limit.due(59 * SECOND) == []
    assert limit.due(60 * SECOND) == [Alarm(flapping[-1], suppressed=2)]
    assert limit.due(60 * SECOND) == []
    assert limit.take(LOST, 61 * SECOND) == []
    assert limit.due(120 * SECOND) == [Alarm(LOST)]
    assert limit.take(LOST, 180 * SECOND) == [Alarm(LOST)]


def test_subjects_do_not_suppress_each_other() -> None:
    """Another station, another event, another geofence; but the same geofence with other numbers."""
    limit = limiter()
    others = (
        LOST,
        replace(LOST, station=3),
        EXITED,
        replace(EXITED, message="geofence yard 2 exited: 2 m beyond"),
        replace(EXITED, message="geofence yard: A exited: 2 m beyond"),
        replace(EXITED, message="geofence yard: B exited: 2 m beyond"),
    )
    for event in others:
        assert limit.take(event, 0) == [Alarm(event)]
    assert limit.take(replace(EXITED, message="geofence yard exited: 3 m beyond"), 0) == []


@pytest.mark.parametrize("events", [["station_lost"], ["station_lost", "station_recovered"]])
def test_last_alarm_is_of_the_state_that_lasts(events: list[str]) -> None:
    """What is held back of a state that has ended is never sent; the next of its kind counts it."""
    limit = AlarmLimiter(events, 60 * SECOND)
    sent: list[tuple[int, str, int | None]] = []
    happened = {
        0: "lost",
        5: "recovered",
        60: "lost",
        61: "recovered",
        62: "lost",
        64: "recovered",
        300: "lost",
    }
    for second in range(400):
        alarms = limit.due(second * SECOND)
        if second in happened:
            event = replace(LOST, event=f"station_{happened[second]}", stamp_ns=second * SECOND)
            alarms += limit.take(event, second * SECOND)
        sent += [(second, each.event.event, each.suppressed) for each in alarms]
    lost = [each for each in sent if each[1] == "station_lost"]
    assert lost == [(0, "station_lost", 0), (60, "station_lost", 0), (300, "station_lost", 1)]
    recovered = [second for second, name, _ in sent if name == "station_recovered"]
    assert recovered == ([5, 65] if len(events) > 1 else [])


def test_what_ends_a_state_names_no_station_where_it_concerns_all() -> None:
    """The residual of the layout is high because of one station, and normal again for all."""
    limit = AlarmLimiter(["layout_residual_high"], 60 * SECOND)
    high = replace(LOST, event="layout_residual_high")
    assert limit.take(high, 0) == [Alarm(high)]
    assert limit.take(high, 10 * SECOND) == []
    assert limit.take(replace(high, event="layout_residual_normal", station=None), 20 * SECOND) == []
    assert limit.due(100 * SECOND) == []


@pytest.mark.parametrize("name", ["layout_residual_high", "imu_setup_wrong", "station_contradicted"])
def test_new_set_up_ends_what_was_wrong_with_the_old_one(name: str) -> None:
    """The master is not to be reported as wrong after it took another set-up."""
    limit = AlarmLimiter([name], 60 * SECOND)
    wrong = replace(LOST, event=name)
    assert limit.take(wrong, 0) == [Alarm(wrong)]
    assert limit.take(wrong, 10 * SECOND) == []
    assert limit.take(replace(wrong, event="setup_applied", station=None), 20 * SECOND) == []
    assert limit.due(100 * SECOND) == []


def test_alarm_is_the_line_of_the_event_with_the_site() -> None:
    """Whatever the name of the site."""
    line = json.loads(Alarm(LOST, suppressed=3).line('Steinbruch "Süd"\n'))
    assert line.pop("site") == 'Steinbruch "Süd"\n'
    assert line.pop("suppressed") == 3
    assert (line["type"], line["event"], line["station"]) == ("event", "station_lost", 2)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"site": "x"}, "give a command or a webhook"),
        ({"site": "x", "webhook": "ftp://example.org"}, "no address of a web server"),
        ({"site": "x", "webhook": "https:///alarm"}, "no address of a web server"),
        ({"site": "x", "webhook": "https://user:word@example.org/"}, "a user or a password"),
        ({"site": "x", "webhook": "https://example.org/\r\nHost: other"}, "cannot have"),
        ({"site": "x", "webhook": "https://example.org:99999/"}, "ort"),
        ({"site": "x", "command": ("true",), "events": ("station_list",)}, "station_lost"),
    ],
)
def test_wrong_configuration_is_rejected(table: dict[str, Any], message: str) -> None:
    """A wrong name of an event would never raise an alarm."""
    with pytest.raises(ValueError, match=message):
        AlarmsConfig(**table)


class Deliveries:
    """Stands for ``run_command``: records calls, and fails the first ones."""

    def __init__(self, failures: int = 0) -> None:
        self.calls: list[tuple[Sequence[str], Mapping[str, str], dict[str, Any]]] = []
        self.failures = failures

    async def __call__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        *,
        stdin: bytes,
        explains_failure: bool = False,
    ) -> str:
        """Take a call."""
        assert explains_failure == ("tsgt.master.webhook" in command)
        self.calls.append((command, environment, json.loads(stdin)))
        self.failures -= 1
        return "no network" if self.failures >= 0 else ""


CONFIG = AlarmsConfig(site="yard", command=("siren", "--loud"), min_interval_s=60.0)
WEBHOOK = AlarmsConfig(site="yard", webhook="https://example.org/alarm?key=secret", min_interval_s=60.0)


async def delivered(config: AlarmsConfig, deliveries: Deliveries, events: int, for_s: float) -> None:
    """Send events of as many stations, and run for a while of virtual time."""
    clock = VirtualClock(0)
    with patch.object(alarms_module, "run_command", deliveries):
        sender = Alarms(config, clock, clock.monotonic_ns)
        task = asyncio.create_task(sender.run())
        for number in range(events):
            sender.take(replace(LOST, station=number))
        await asyncio.sleep(for_s)
        task.cancel()
        await asyncio.wait([task])


async def test_command_gets_the_alarm() -> None:
    """On stdin and in its environment; its arguments are those of the configuration."""
    deliveries = Deliveries()
    await delivered(CONFIG, deliveries, 1, 1.0)
    ((command, environment, line),) = deliveries.calls
    assert command == ("siren", "--loud")
    assert environment == {
        "TSGT_EVENT": "station_lost",
        "TSGT_SITE": "yard",
        "TSGT_MESSAGE": "station 2 lost",
        "TSGT_STATION": "0",
    }
    assert (line["event"], line["site"]) == ("station_lost", "yard")


async def test_web_server_is_tried_again() -> None:
    """Mobile networks have gaps; its address and key are not in the list of processes."""
    deliveries = Deliveries(failures=len(RETRY_DELAYS_S))
    with capture_logs() as logs:
        await delivered(WEBHOOK, deliveries, 1, sum(RETRY_DELAYS_S) + 1)
    assert len(deliveries.calls) == 1 + len(RETRY_DELAYS_S)
    command, _, request = deliveries.calls[-1]
    assert not any("example" in argument for argument in command)
    assert request["url"] == WEBHOOK.webhook
    assert json.loads(request["body"])["event"] == "station_lost"
    assert [log["event"] for log in logs] == ["alarm_sent"]
    assert "secret" not in str(logs)


async def test_failures_are_logged_with_a_limit() -> None:
    """Alarms that are too many for a target that fails are dropped, the oldest first."""
    deliveries = Deliveries(failures=1000)
    with capture_logs() as logs:
        await delivered(CONFIG, deliveries, MAX_WAITING + 20, 1.0)
    assert [log["event"] for log in logs] == ["alarms_lost", "alarm_failed"]
    assert len(deliveries.calls) == MAX_WAITING
    assert deliveries.calls[-1][2]["station"] == MAX_WAITING + 19


async def test_held_alarm_follows_after_the_interval() -> None:
    """Without another event."""
    clock, deliveries = VirtualClock(0), Deliveries()
    with patch.object(alarms_module, "run_command", deliveries):
        sender = Alarms(CONFIG, clock, clock.monotonic_ns)
        task = asyncio.create_task(sender.run())
        sender.take(LOST)
        await asyncio.sleep(10)
        sender.take(LOST)
        await asyncio.sleep(49)
        assert len(deliveries.calls) == 1
        await asyncio.sleep(2)
        assert len(deliveries.calls) == 2
        task.cancel()
        await asyncio.wait([task])


class Server:
    """A web server on the loopback address with one answer."""

    def __init__(self, answer: int) -> None:
        self.answer = answer
        self.bodies: list[bytes] = []
        self.headers: list[dict[str, str]] = []


@contextmanager
def web_server(answer: int) -> Iterator[tuple[str, Server]]:
    """Serve; yield the address and what was received."""
    served = Server(answer)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            served.bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            served.headers.append(dict(self.headers))
            self.send_response(answer)
            self.send_header("Location", f"http://127.0.0.1:{server.server_port}/elsewhere")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/alarm", served
        finally:
            server.shutdown()
            thread.join()


def test_alarm_is_posted_as_json() -> None:
    """A success is any 2xx."""
    with web_server(204) as (url, served):
        assert post(url, b'{"event":"x"}') == ""
    assert served.bodies == [b'{"event":"x"}']
    assert served.headers[0]["Content-Type"] == "application/json"


@pytest.mark.parametrize(("answer", "text"), [(302, "redirects (302)"), (307, "redirects"), (500, "500")])
def test_other_answers_are_failures(answer: int, text: str) -> None:
    """A redirect is not followed: the alarm goes nowhere else."""
    with web_server(answer) as (url, served):
        assert text in post(url, b"{}")
    assert len(served.bodies) == 1


def test_unreachable_servers_are_failures() -> None:
    """Refused, silent, without TLS, and one that speaks another protocol."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        assert "has not responded within 0.05 s" in post(f"http://127.0.0.1:{port}/", b"{}", 0.05)
    assert "refused" in post(f"http://127.0.0.1:{port}/", b"{}")
    with web_server(200) as (url, served):
        assert "cannot be reached" in post(url.replace("http:", "https:"), b"{}")
    assert served.bodies == []
