"""Drivers of ToF cameras, a file each."""
