"""The ROS 2 skin: one thin file per node, and the only place that knows messages."""
