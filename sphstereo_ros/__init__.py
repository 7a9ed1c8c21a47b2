"""Depth in every direction from one 360-degree camera: spherical stereo from motion."""

__version__ = '0.1.0'
