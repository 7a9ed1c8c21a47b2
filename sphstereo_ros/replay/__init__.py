"""Bags, videos and folders of frames, in and out."""
