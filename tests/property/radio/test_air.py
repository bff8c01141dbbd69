"""Arbitrary traffic: the channel does not fail, and every lock has an end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from harness.radio.air import RecordingListener, frame, modulation
from hypothesis import given
from hypothesis import strategies as st

from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.lora import Air, LinkModel
from tsgt.simulation.lora.frames import Frame, Modulation, ReceiverSettings
from tsgt.simulation.lora.link import FixedLoss

NAMES = ("a", "b", "c")

MODULATIONS = st.builds(
    Modulation,
    # Two values each, so that frames and receivers often match.
    frequency_hz=st.sampled_from([905e6, 905.05e6, 0.0]),
    spreading_factor=st.sampled_from([6, 7, 12]),
    bandwidth_hz=st.sampled_from([500_000, 7_800]),
    inverted_iq=st.booleans(),
    sync_word=st.sampled_from([0x12, 0x34]),
    explicit_header=st.booleans(),
    low_data_rate=st.booleans(),
)
PLAIN = modulation(spreading_factor=7, bandwidth_hz=500_000)


@dataclass(frozen=True)
class RadioAction:
    """An action of a radio at a time."""

    radio: str
    what: str
    after_ns: int
    settings: dict[str, Any]


def radio_actions(modulations: st.SearchStrategy[Modulation]) -> st.SearchStrategy[list[RadioAction]]:
    """Generate sequences of actions."""
    sending = st.fixed_dictionaries(
        {
            "modulation": modulations,
            "coding_rate": st.integers(5, 8),
            "crc": st.booleans(),
            "preamble_symbols": st.sampled_from([0, 6, 8, 20]),
            "payload": st.binary(max_size=255),
            "power_dbm": st.sampled_from([-90.0, -20.0, 8.0, 14.0, 20.0]),
        }
    )
    receiving = st.fixed_dictionaries(
        {
            "modulation": modulations,
            "preamble_symbols": st.sampled_from([0, 8, 30]),
            "max_payload_bytes": st.sampled_from([0, 64, 255]),
            "payload_bytes": st.integers(0, 255),
            "coding_rate": st.integers(5, 8),
            "crc": st.booleans(),
        }
    )
    radios = st.sampled_from(NAMES)
    gaps_ns = st.integers(0, 20_000_000)
    return st.lists(
        st.one_of(
            st.builds(RadioAction, radios, st.just("transmit"), gaps_ns, sending),
            st.builds(RadioAction, radios, st.just("listen"), gaps_ns, receiving),
            st.builds(
                RadioAction, radios, st.sampled_from(["deaf", "stop", "leave", "ask"]), gaps_ns, st.just({})
            ),
        ),
        max_size=40,
    )


class StrictListener(RecordingListener):
    """Checks the order of events: a lock, possibly a header, an end, with increasing times."""

    def __init__(self) -> None:
        super().__init__()
        self.locked = False

    def preamble_detected(self, at_ns: int) -> None:
        """Check that a receiver does not lock twice."""
        assert not self.locked
        self.locked = True
        super().preamble_detected(at_ns)

    def header_received(self, at_ns: int, header: Any) -> None:
        """Check that a header belongs to a lock."""
        assert self.locked
        super().header_received(at_ns, header)

    def frame_ended(self, at_ns: int, reception: Any) -> None:
        """Check that an end belongs to a lock."""
        assert self.locked
        self.locked = False
        if reception is not None:
            assert len(reception.payload) == reception.header.payload_bytes
        super().frame_ended(at_ns, reception)


@given(
    st.one_of(radio_actions(MODULATIONS), radio_actions(st.just(PLAIN))),
    st.integers(0, 2**32),
    st.sampled_from([60, 120]),
)
def test_arbitrary_traffic(sequence: list[RadioAction], seed: int, loss_db: float) -> None:
    """Arbitrary frames, receivers, cuts and departures raise nothing; every lock ends; nothing is left behind."""
    timeline = VirtualTimeline()
    link = LinkModel(path_loss=FixedLoss(default_db=loss_db), rayleigh_fading=True)
    air = Air(timeline, np.random.default_rng(seed), link)
    listeners = {name: StrictListener() for name in NAMES}
    ports = {name: air.join(listeners[name], name) for name in NAMES}
    for action in sequence:
        timeline.advance(action.after_ns)
        now_ns, port, listener = timeline.now_ns(), ports[action.radio], listeners[action.radio]
        if action.what == "transmit":
            port.transmit(Frame(start_ns=now_ns, **action.settings))
        elif action.what == "stop":
            port.stop_transmitting(now_ns)
        elif action.what == "ask":
            assert np.isfinite(port.rssi_dbm(now_ns))
            port.preamble_present(PLAIN, now_ns)
        else:
            listener.locked = False
            port.listen(
                ReceiverSettings(since_ns=now_ns, **action.settings) if action.what == "listen" else None
            )
            if action.what == "leave":
                air.leave(action.radio)
                ports[action.radio] = air.join(listener, action.radio)
    while (next_ns := timeline.next_ns()) is not None:
        timeline.advance_to(next_ns)
    for listener in listeners.values():
        assert not listener.locked
        assert listener.events == sorted(listener.events, key=lambda event: event[0])
    timeline.advance(10**15)
    ports["a"].transmit(frame(start_ns=timeline.now_ns()))
    assert len(air.frames) == 1
