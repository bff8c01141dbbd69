"""What the master watches beside the radio: geofences, the layout of stations and prisms, the use of the IMU, the disk.

In: poses and what they rest on (`observers` connects them with the publisher), results of writing. Out: events for the stream and the
recording, and the configured command of a geofence.
"""

from tsgt.master.monitors.disk import RecordingDisk, disk_status
from tsgt.master.monitors.imu import ImuUseMonitor, OdometryUseMonitor
from tsgt.master.monitors.observers import GeofenceObserver, layout_monitor
from tsgt.master.monitors.shocks import ShockMemory

__all__ = [
    "GeofenceObserver",
    "ImuUseMonitor",
    "OdometryUseMonitor",
    "RecordingDisk",
    "ShockMemory",
    "disk_status",
    "layout_monitor",
]
