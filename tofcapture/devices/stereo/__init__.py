"""Drivers of stereo cameras, a file each."""
