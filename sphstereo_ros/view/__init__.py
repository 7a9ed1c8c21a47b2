"""Inputs and results in a viewer, from a bag or as they are published."""
