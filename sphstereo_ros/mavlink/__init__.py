"""Obstacles to a flight controller by MAVLink, without ROS between."""
