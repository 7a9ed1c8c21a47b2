"""The mathematics: NumPy, OpenCV and Numba; no ROS, no clock, no logger."""
