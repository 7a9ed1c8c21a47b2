"""Rendered scenes with exact range and pose."""
