"""Who reads the stream: relay, operator's page, ROS 2."""
