"""Between ROS messages and the core: conversions, parameters, QoS, the shell every node shares."""
