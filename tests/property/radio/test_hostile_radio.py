"""Damaged packets to both sides of a protocol: no error, and normal operation as soon as they stop."""

from __future__ import annotations

import asyncio
import tempfile
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from harness.files.damage import Damage, damages, examples
from harness.missions.missions import QUICK, SUPERFRAME, run_mission
from harness.radio.scripted_stations import KEY, TIMING, counted
from harness.radio.superframe_loop import SuperframeLoop
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from structlog.testing import capture_logs

from tsgt.errors import MessageError
from tsgt.radio.superframe.wire import CODE_BYTES, Authenticator, decode_reply

if TYPE_CHECKING:
    from tsgt.radio import Radio
    from tsgt.simulation.mission import Mission, MissionResult

TRAFFIC_CAPACITY = 50
SETTLING_FRAMES = 15
STATIONS = (1, 2, 3)


class Channel(RuleBasedStateMachine):
    """A master and three stations; between their packets arrive damaged ones, with a valid code or an invalid one.

    Measurements made after the last damaged packet have to arrive. Without a key everybody can compute valid codes, and
    messages with arbitrary contents are accepted; there the test only requires that nothing raises an error.
    """

    authenticated = True

    @initialize(joined=st.booleans())
    def begin(self, joined: bool) -> None:  # noqa: FBT001 (given by hypothesis)
        """Start, before or after the stations have joined."""
        self.authenticator = Authenticator(KEY if self.authenticated else None)
        self.loop = SuperframeLoop(TIMING, self.authenticator, counted(), stations=STATIONS)
        self.beacons: deque[bytes] = deque(maxlen=TRAFFIC_CAPACITY)
        self.replies: deque[bytes] = deque(maxlen=TRAFFIC_CAPACITY)
        for _ in range(4 * joined):
            self.frame()

    def frame(self) -> None:
        """Run an undisturbed frame."""
        self.loop.run_frame()
        self.beacons.append(self.loop.beacon)
        self.replies.extend(self.loop.replies.values())

    @rule(count=st.integers(1, 5))
    def frames(self, count: int) -> None:
        """Run undisturbed frames."""
        for _ in range(count):
            self.frame()

    @rule(
        damage=damages,
        station=st.sampled_from(STATIONS),
        late_ns=st.integers(-(10**6), 10**9),
        right=st.booleans(),
    )
    def to_a_station(self, damage: Damage, station: int, late_ns: int, right: bool) -> None:  # noqa: FBT001 (as above)
        """Send a station a damaged beacon, or a reply of another station."""
        self.loop.send_beacon()
        packet = damage.to([*self.beacons, *self.replies, self.loop.beacon])
        master = self.loop.master
        if right:
            content = packet[:-CODE_BYTES]
            code = Authenticator(None).beacon_code(
                session=master.session, counter=master.counter, content=content
            )
            packet = content + code
        core = self.loop.members[station].core
        received = core.received(self.loop.beacon_packet(station, packet[:255], delay_ns=late_ns))
        if self.authenticated:
            assert received is None or packet == self.loop.beacon or packet in self.beacons
        if core.next_command() is not None:
            core.executed(ok=damage.sample % 2 == 0)
        self.loop.end_frame()

    @rule(
        damage=damages, station=st.sampled_from(STATIONS), after_ns=st.integers(0, 10**9), right=st.booleans()
    )
    def to_the_master(self, damage: Damage, station: int, after_ns: int, right: bool) -> None:  # noqa: FBT001 (as above)
        """Send the master a damaged reply, or a beacon, while it waits for replies."""
        loop = self.loop
        packet = damage.to([*self.replies, *self.beacons] or [b""])
        loop.send_beacon()
        if right:
            content = packet[:-CODE_BYTES]
            try:
                station_state = loop.master.station(station)
                packet = content + Authenticator(None).reply_code(
                    session=loop.master.session,
                    station=station,
                    station_nonce=station_state.nonce or 0,
                    counter=loop.master.counter,
                    beacon_code=loop.beacon[-CODE_BYTES:],
                    sequence=station_state.first_sequence(decode_reply(content)),
                    content=content,
                )
            except MessageError:
                pass
        received = loop.master.received(packet[:255], loop.done_ns + after_ns, 3000)
        if received is not None:
            assert not self.authenticated
            loop.master.station(received.station).window.mark_written(
                [got.sequence for got in received.measurements]
            )
        loop.end_frame()

    def teardown(self) -> None:
        """Run undisturbed frames: soon all new measurements arrive with accurate timestamps."""
        if not hasattr(self, "exchange"):
            return
        for _ in range(SETTLING_FRAMES):
            self.frame()
        loop = self.loop
        before = {number: set(member.made_ns) for number, member in loop.members.items()}
        for _ in range(10):
            self.frame()
        for number, member in loop.members.items():
            new = set(member.made_ns) - before[number]
            arrived = new & set(member.received)
            errors = member.errors_ns()
            if self.authenticated:
                assert len(arrived) >= len(new) - 3, f"station {number}: {len(arrived)} of {len(new)}"
                assert all(abs(errors[sequence]) < 1_000_000 for sequence in arrived)


class OpenChannel(Channel):
    """The same without a key."""

    authenticated = False


_SETTINGS = settings(examples(4), stateful_step_count=20)
TestWithAKey = Channel.TestCase
TestWithAKey.settings = _SETTINGS
TestWithoutAKey = OpenChannel.TestCase
TestWithoutAKey.settings = _SETTINGS


# --- Whole daemons, with radios

HOSTILE_S = (2.0, 5.0)
"""Start and end of the attack. The stations have just joined; a classic master is still setting their clocks."""

END_S = 9.0
pauses_ms = st.sampled_from([0, 1, 20, 60, 150, 300])


async def attack(mission: Mission, script: list[tuple[Damage, int]]) -> None:
    """Receive the traffic and send damaged packets for some seconds."""
    recent: deque[bytes] = deque(maxlen=TRAFFIC_CAPACITY)

    async def listen(radio: Radio) -> None:
        while True:
            recent.append((await radio.receive()).payload)

    await mission.sleep_until(0.5)
    async with mission.interferer_radio("attacker")() as radio:
        listening = asyncio.create_task(listen(radio))
        try:
            await mission.sleep_until(HOSTILE_S[0])
            for damage, pause_ms in script:
                if mission.now_s > HOSTILE_S[1]:
                    break
                await asyncio.sleep(pause_ms / 1e3)
                await radio.transmit((damage.to(list(recent)[::-1] or [b"x"]) or b"x")[:255])
        finally:
            listening.cancel()
            await asyncio.wait([listening])


def delivered(run: MissionResult, since_s: float) -> int:
    """Count the measurements made since then that reached the pipeline."""
    since_ns = run.start_ns + round(since_s * 1e9)
    return sum(
        measurement.stamp_ns >= since_ns
        for session in run.master_logs
        for measurement in session.measurements
    )


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["classic", "superframe", "superframe without a key"])
@examples(1)
@given(script=st.lists(st.tuples(damages, pauses_ms), min_size=20, max_size=80))
def test_daemons_survive_damaged_packets(protocol: str, script: list[tuple[Damage, int]]) -> None:
    """Master and clients measure at their rate afterwards."""
    with tempfile.TemporaryDirectory() as folder, capture_logs():
        run = run_mission(
            Path(folder),
            duration_s=END_S,
            protocol=QUICK if protocol == "classic" else SUPERFRAME,
            authenticated=protocol == "superframe",
            script=lambda running: attack(running, script),
        )
    # Three stations at 2.5 Hz over the superframe; about half of that over classic.
    least = 10 if protocol == "classic" else 40
    assert delivered(run, END_S - 3.0) >= least
