"""TODO face."""

from tsgt.simulation.demo.config_files import DemoFiles, write_demo_files
from tsgt.simulation.demo.demo import Demo

__all__ = [
    "Demo",
    "DemoFiles",
    "write_demo_files",
]
