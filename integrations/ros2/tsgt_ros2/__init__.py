"""Nodes between tsgt and ROS 2."""
