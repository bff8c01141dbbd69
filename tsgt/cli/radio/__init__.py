"""The group ``radio``: airtime, channel plan, bench test of two radios, and the key of a mission.

``options`` makes the options of modem and wiring from their configuration models.
"""
