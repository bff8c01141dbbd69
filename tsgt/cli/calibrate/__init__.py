"""The group ``calibrate``: targets, prisms and recordings in, station frames, prism layout, latencies and the IMU's mounting out.

``group`` solves from files, ``motion`` and ``imu`` from a recording. ``collect`` and ``check`` measure targets over the radio:
``session`` opens it, ``commands`` sends commands to the stations in either protocol.
"""
