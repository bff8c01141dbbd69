"""Demonstration: the real daemons as processes, with simulated radios, instruments and robot, in real time.

In: a scenario, a duration, a seed. Out: a folder of configuration files, running daemons, lines of the pose stream.
"""

from tsgt.simulation.demo.config_files import DemoFiles, write_demo_files
from tsgt.simulation.demo.demo import Demo

__all__ = [
    "Demo",
    "DemoFiles",
    "write_demo_files",
]
