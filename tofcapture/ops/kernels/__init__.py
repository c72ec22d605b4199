"""Compiled loops behind the ops; imported by them when they are called, since numba takes half a second to load."""
