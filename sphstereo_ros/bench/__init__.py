"""Benchmarks: accuracy, speed, live."""
