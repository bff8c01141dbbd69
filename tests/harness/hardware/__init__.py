"""Fakes of a Raspberry Pi and of the SX127x: buses, pins, registers, modules of third-party drivers, a whole computer."""
