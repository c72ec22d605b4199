"""Readers of files that others wrote; :mod:`tofcapture.importing.source` says what a reader is."""
