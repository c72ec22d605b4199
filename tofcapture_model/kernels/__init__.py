"""Compiled loops behind the losses; imported when they are called, since numba takes half a second to load and is optional."""
