"""Package for colcon; the nodes also run as files."""

from setuptools import setup

NAME = "tsgt_ros2"

setup(
    name=NAME,
    version="1.0.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    entry_points={
        "console_scripts": [
            f"pose_publisher = {NAME}.pose_publisher:main",
            f"imu_lines = {NAME}.imu_lines:main",
            f"odometry_lines = {NAME}.odometry_lines:main",
        ]
    },
)
