"""The station's side of the superframe: packets, times and measurements in, replies and commands out. Sans-I/O.

A station replies to everybody who proves to have the key. It sends a join request with a nonce; until a beacon with this
nonce confirms that the packets are no replay, it accepts no acknowledgement, command or time. Another authentic session is
a candidate only while the confirmed one is silent, and dropped as soon as that is received again.
"""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING

from tsgt.errors import MessageError
from tsgt.radio.superframe.reply_builder import ReplyBuilder
from tsgt.radio.superframe.session import AuthenticBeacon, StationSession, full_counter
from tsgt.radio.superframe.slots import EXACT_SIGMA_NS
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    CommandResponse,
    SingleMeasurement,
    StatusReport,
    decode_beacon,
    distance_code,
    encode_reply,
)
from tsgt.timesync import BeaconClock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.model import Status
    from tsgt.radio.base import LoRaSettings, Packet, Transmission
    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.command_exchange import CommandExchange, InstrumentState
    from tsgt.radio.superframe.send_queue import SendQueue
    from tsgt.radio.superframe.session import BeaconReception, ReceivedBeacon
    from tsgt.radio.superframe.wire import Authenticator, Beacon

SESSION_TIMEOUT_NS = 3_000_000_000
"""Another session becomes a candidate only when the confirmed one has been silent for longer."""

PREPARATION_NS = 1_000_000  # what a radio needs to start a transmission immediately

_NONCE_BITS = 32


class SuperframeStation:
    """Decides what a station sends.

    Parameters
    ----------
    send_queue
        Measurements are added to it as soon as they are journalled.
    stream_id
        16 bits, constant while sequence numbers continue across restarts.
    boot
        Boot id of this computer's clock.
    receptions
        Clock samples journalled by earlier runs, in their order.

    Attributes
    ----------
    authentication_failures
        Packets that looked like a beacon with a session item and had a wrong code.
    missed_slots
        Slots left empty because the computer was late, or overrun.
    rejected_beacons
        Beacons rejected for an impossible time.
    heard_ns, rssi_dbm, snr_db
        RxDone and signal of the latest authentic beacon; None before the first.
    """

    def __init__(
        self,
        station: int,
        settings: LoRaSettings,
        authenticator: Authenticator,
        send_queue: SendQueue,
        *,
        stream_id: int,
        boot: str,
        receptions: Iterable[BeaconReception] = (),
        random_bits: Callable[[int], int],
    ) -> None:
        self._station = station
        self._settings = settings
        self._authenticator = authenticator
        self._queue = send_queue
        self._boot = boot
        self._random_bits = random_bits
        self._builder = ReplyBuilder(send_queue, stream_id)
        self._clocks: dict[int, dict[str, BeaconClock]] = {}
        for reception in receptions:
            clock = self._clocks.setdefault(reception.session, {}).setdefault(reception.boot, BeaconClock())
            clock.add(reception.received_ns, reception.sent_us, reception.sigma_ns, unambiguous=True)
        self._confirmed: StationSession | None = None
        self._candidate: StationSession | None = None
        self._latest_start_ns = 0
        self._executing: tuple[CommandExchange, int] | None = None
        self.missed_slots = self.rejected_beacons = self.authentication_failures = 0
        self.heard_ns: int | None = None
        self.rssi_dbm: float | None = None
        self.snr_db: float | None = None

    @property
    def session(self) -> StationSession | None:
        """The session that the station replies to: the candidate, or else the confirmed one."""
        return self._candidate or self._confirmed

    @property
    def joined(self) -> bool:
        """Whether a master has confirmed the station, and there is no other candidate."""
        session = self.session
        return session is not None and session.confirmed

    def clock_bound_us(self, now_ns: int) -> float | None:
        """Return the bound of the master's time on this clock; None if it is unknown."""
        session = self.session
        time = None if session is None else session.clock.at(now_ns)
        return None if time is None else time.bound_us

    # --- Beacons ----------------------------------------------------------------------------------------------

    def received(self, packet: Packet) -> ReceivedBeacon | None:
        """Take any packet; return None if it is no authentic beacon of an acceptable session."""
        try:
            beacon = decode_beacon(packet.payload[:-CODE_BYTES])
        except MessageError:
            return None
        found = self._identify(beacon, packet) or self._begin_session(beacon, packet)
        if found is None:
            return None
        session, authentic = found
        if session is self._confirmed:
            self._candidate = None
        received = session.take(authentic)
        if received.joined:
            self._confirmed, self._candidate = session, None
            self._clocks.clear()  # no other session needs them
        self.heard_ns, self.rssi_dbm, self.snr_db = packet.received_at_ns, packet.rssi_dbm, packet.snr_db
        self.rejected_beacons += received.time_rejected
        return received

    def _identify(self, beacon: Beacon, packet: Packet) -> tuple[StationSession, AuthenticBeacon] | None:
        """Return the known session in which a beacon is authentic."""
        for session in (self._confirmed, self._candidate):
            if session is None or (counter := session.counter_of(beacon)) is None:
                continue
            if authentic := self._authenticated(beacon, session.master_nonce, counter, packet):
                return session, authentic
        return None

    def _begin_session(self, beacon: Beacon, packet: Packet) -> tuple[StationSession, AuthenticBeacon] | None:
        """Start a candidate session with a beacon."""
        info = beacon.session
        if info is None or not self._accepts_session(info.nonce, packet.received_at_ns):
            return None
        authentic = self._authenticated(beacon, info.nonce, full_counter(info, beacon), packet)
        if authentic is None:
            self.authentication_failures += 1
            return None
        self._candidate = StationSession(
            self._station,
            authentic,
            info,
            self._random_bits(_NONCE_BITS),
            self._settings,
            self._queue,
            self._boot,
            self._clocks.get(info.nonce, {}),
        )
        return self._candidate, authentic

    def _authenticated(
        self, beacon: Beacon, master_nonce: int, counter: int, packet: Packet
    ) -> AuthenticBeacon | None:
        content, code = packet.payload[:-CODE_BYTES], packet.payload[-CODE_BYTES:]
        expected = self._authenticator.beacon_code(session=master_nonce, counter=counter, content=content)
        if not hmac.compare_digest(expected, code):
            return None
        return AuthenticBeacon(beacon, code, counter, packet.received_at_ns, packet.stamp_sigma_ns)

    def _accepts_session(self, master_nonce: int, now_ns: int) -> bool:
        """Whether an unknown session may become the candidate."""
        known = [session for session in (self._confirmed, self._candidate) if session is not None]
        if any(session.master_nonce == master_nonce for session in known):
            return False  # a replayed beacon of a known session
        return self._confirmed is None or now_ns - self._confirmed.beacon.received_ns >= SESSION_TIMEOUT_NS

    # --- Commands ---------------------------------------------------------------------------------------------

    def next_command(self) -> Command | None:
        """Return the next command to execute; None while another one is being executed."""
        session = self._confirmed
        following = None if self._executing or session is None else session.commands.next_command()
        if following is None or session is None:
            return None
        command_id, command = following
        self._executing = session.commands, command_id
        return command

    def executed(self, *, ok: bool) -> None:
        """Report the result of the command; of a single measurement only a failure."""
        commands, command_id = self._complete()
        commands.responses.append(CommandResponse(command_id, ok))

    def measured(self, status: Status, horizontal: int, zenith: int, distance_m: float | None) -> None:
        """Report the result of a single measurement; angles encoded."""
        commands, command_id = self._complete()
        distance = distance_code(distance_m, far=False)
        commands.single_measurements.append(
            SingleMeasurement(command_id, status, horizontal, zenith, distance)
        )

    def _complete(self) -> tuple[CommandExchange, int]:
        if self._executing is None:
            raise RuntimeError("a result was reported while no command is being executed")
        executing, self._executing = self._executing, None
        return executing

    # --- Replies ----------------------------------------------------------------------------------------------

    def compose(self, instrument_state: InstrumentState, now_ns: int) -> bytes | None:
        """Return the reply for the slot, composed as late as possible; None: no slot, too late, or slot too short.

        Composing takes a while: ask :meth:`misses_slot` again before the reply is transmitted.
        """
        session = self.session
        if session is None or session.slot is None:
            return None
        slot, session.slot = session.slot, None
        report = self._status_report(instrument_state, session)
        reply, sequences = self._builder.build(session, slot, instrument_state, report)
        if not session.confirmed and reply.join_request is None:
            return None  # the master could not authenticate it; it grants more to unknown stations
        content = encode_reply(reply)
        length = len(content) + CODE_BYTES
        self._latest_start_ns = slot.beacon_end_ns + session.timing.latest_start_ns(slot.slot, length)
        if self.misses_slot(now_ns):
            return None
        session.reply_sent(reply, sequences)
        return content + self._authenticator.reply_code(
            session=session.master_nonce,
            station=self._station,
            station_nonce=session.nonce,
            counter=session.beacon.counter,
            beacon_code=session.beacon.code,
            sequence=sequences[0] if sequences else 0,
            content=content,
        )

    def misses_slot(self, now_ns: int) -> bool:
        """Whether the composed reply would be late if its transmission started now; counts that as a missed slot."""
        late = now_ns + PREPARATION_NS > self._latest_start_ns
        self.missed_slots += late
        return late

    def sent(self, transmission: Transmission) -> None:
        """Take the transmission of the last composed reply."""
        self.missed_slots += transmission.started_at_ns > self._latest_start_ns
        session = self.session
        if (
            session is not None
            and session.last_reply is not None
            and transmission.stamp_sigma_ns <= EXACT_SIGMA_NS
        ):
            session.last_reply.done_ns = transmission.done_at_ns

    def _status_report(self, state: InstrumentState, session: StationSession) -> StatusReport:
        return StatusReport(
            prism=state.prism,
            direct=state.direct,
            connected=state.connected,
            missed_slots=self.missed_slots % 256,
            rejected_beacons=self.rejected_beacons % 16,
            rssi_dbm=min(max(round(self.rssi_dbm or 0), -127), 0),
            condition=session.commands.conditions.next(state.condition),
        )
