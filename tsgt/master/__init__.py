"""The master on the robot: measurements to poses, and the stream of both."""
