"""The radio: settings, packets, and what the program asks of any LoRa radio."""

from __future__ import annotations

from tsgt.radio.base import LoRaSettings, Packet, Radio, Transmitted

__all__ = ["LoRaSettings", "Packet", "Radio", "Transmitted"]
