"""What the page may claim by its own clocks: its own code, run in node."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

NODE = shutil.which("node")
PAGE_IN_NODE = Path(__file__).with_name("page_in_node.js")

pytestmark = pytest.mark.skipif(NODE is None, reason="node, which runs the page's code, is not installed")


def run(scenario: str, replay: str = "no") -> Any:
    """Return the result of a scenario; ``page_in_node.js`` has its words. ``replay``: yes or no."""
    page = resources.files("tsgt.web") / "page" / "page.js"
    found = subprocess.run(
        [str(NODE), PAGE_IN_NODE, str(page), scenario, replay], check=True, capture_output=True, timeout=60
    )
    return json.loads(found.stdout)


def test_messages_in_time_are_good() -> None:
    """On one connection."""
    assert run("return [...new Set(run(60000)), connections.length]") == ["GOOD", 1]


def test_silence_is_no_connection_and_one_new_connection_in_four_seconds() -> None:
    """Not one with each look at the clock."""
    shown, count = run("""
        run(10000);
        pass(1600);
        const shown = words();
        for (let i = 0; i < 100; i += 1) { pass(200); timers(); }
        return [shown, connections.length];
    """)
    assert shown == "NO CONNECTION"
    assert 4 <= count <= 7


@pytest.mark.parametrize("opened_ms", [10_000, 1000])
def test_message_from_before_sleep_is_not_shown_as_one_of_now(opened_ms: int) -> None:
    """A device whose steady clock stood still has one in the buffer of its socket, perhaps of a new connection."""
    slept, buffered, later = run(f"""
        run({opened_ms});
        const sent = sent_s() + 0.2;
        pass(600000, 5);
        robot.ahead_s += 600;
        timers();
        const slept = words();
        const old = connections.at(-1);
        for (const later_s of [0, 0.2, 0.4]) old.onmessage({{ data: text(sent + later_s) }});
        return [slept, words(), run(8000)];
    """)
    assert (slept, buffered) == ("NO CONNECTION", "NO CONNECTION")
    assert later[-1] == "GOOD"


def test_first_message_from_before_sleep_is_not_shown_as_one_of_now() -> None:
    """The connection itself was made before the sleep."""
    shown, later = run("""
        const sent = sent_s();
        pass(600000, 5);
        robot.ahead_s += 600;
        message(sent);
        return [words(), run(8000)];
    """)
    assert shown == "NO CONNECTION"
    assert later[-1] == "GOOD"


@pytest.mark.parametrize("suspended_s", [2, 3, 5, 20, 59, 600])
def test_page_follows_a_robot_that_was_suspended(suspended_s: int) -> None:
    """Its clock stood still meanwhile, so that its messages look late: a new connection shows that they are not."""
    shown, count = run(f"""
        run(10000);
        pass({suspended_s} * 1000);
        robot.ahead_s -= {suspended_s};
        return [run(60000), connections.length];
    """)
    assert set(shown[25:]) == {"GOOD"}
    assert count == 2


def test_page_follows_a_robot_that_was_restarted() -> None:
    """Its clock began again; the connection was closed and made again by the browser."""
    shown = run("""
        run(10000);
        connections[0].readyState = 0;
        connections[0].onerror();
        robot.ahead_s = -100;
        connections[0].fresh = true;
        return run(10000);
    """)
    assert set(shown) == {"GOOD"}


def test_replay_goes_on_where_its_connection_was_lost() -> None:
    """The browser by itself would ask for the address of the first connection again, and so for the start."""
    assert run(
        """
        content.replay = { at_s: 600, speed: 1 };
        run(1000);
        connections[0].readyState = 0;
        connections[0].onerror();
        pass(1200);
        timers();
        return connections.map(({ url }) => url);
        """,
        replay="yes",
    ) == ["/stream", "/stream?at=600.0&speed=1"]


def test_position_and_speed_are_those_of_a_valid_pose() -> None:
    """An earlier or invalid one may have numbers as well; they are no facts of now."""
    assert run("""
        view.pose = { at: [1, 2, 0.5], heading_rad: 0, prisms: {}, speed_mps: 0.9, valid: true, age_s: 0.1 };
        message();
        const valid = facts();
        view.pose.valid = false;
        message();
        return [valid, facts()];
    """) == [["robot", "x 1.00, y 2.00, z 0.50 m; 0.9 m/s"], []]


def test_item_that_comes_twice_is_listed_once() -> None:
    """A page that has just connected gets the newest ones with its first message, and again with the next."""
    assert run("""
        const events_from = (first, ...texts) => {
            content.events = { first, items: texts.map((text) => ({ text, stamp_ms: 0 })) };
            message();
        };
        events_from(7, "a", "b");
        events_from(8, "b", "c");
        events_from(10, "d");
        return events().map(({ text }) => text);
    """) == ["a", "b", "c", "d"]


def test_new_frame_empties_the_map() -> None:
    """The trail begins anew behind a gap, and there is no last known position; the same set-up changes nothing."""
    assert run("""
        const shown = () => [map.trail.map(([x]) => x), map.last];
        const found = [];
        content.setup = { stations: [{ id: 2, at: [0, 10] }] };
        content.trail = { first: 0, items: [[1], [2]] };
        message();
        map.last = "here";
        content.trail = { first: 2, items: [[3]] };
        message();
        found.push(shown());
        content.setup = { stations: [{ id: 2, at: [30, 10] }] };
        content.trail = { first: 4, items: [[9]] };
        message();
        found.push(shown());
        return found;
    """) == [[[1, 2, 3], "here"], [[9], None]]


def test_share_of_a_minute_and_counts_of_the_mission_are_told_apart() -> None:
    """And a share below one is never 100 %."""
    assert run("""
        view.figures = { valid_share: 0.999, poses: 1472, valid_poses: 287 };
        message();
        return [textOf("f-valid", "b"), textOf("f-valid", ".small")];
    """) == ["99.9 %", "last minute; 287 of 1472 since the start"]


def test_late_messages_are_no_connection() -> None:
    """On no connection, and a new one is tried every four seconds at most."""
    shown, count = run("""
        run(10000);
        const shown = [];
        let count = connections.length, age_ms = 3000;
        for (let i = 0; i < 300; i += 1) {
            pass(200);
            age_ms = connections.length === count ? age_ms + 200 : 0;
            count = connections.length;
            if (age_ms > 3000) message(sent_s() - 3);
            timers();
            shown.push(words());
        }
        return [shown, count - 1];
    """)
    assert set(shown) == {"NO CONNECTION"}
    assert 10 <= count <= 15
