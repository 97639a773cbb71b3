"""ROS 2 CDR: the codec, typed messages, many messages at once, camera images."""
