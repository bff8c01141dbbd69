"""Readers of the stream: browsers, Foxglove, ROS 2, and the network between."""
