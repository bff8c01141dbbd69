"""The robot's IMU: accuracy of poses with it, its calibration, its faults, wrong set-ups, two stations and one."""
