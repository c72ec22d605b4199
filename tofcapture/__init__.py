"""Capture paired time-of-flight raw data and stereo ground truth, and build datasets from them.

Importing this package loads nothing else: every room is imported by its own name
(``tofcapture.files.view``, ``tofcapture.ops.phase`` ...), so that a reader of the data needs numpy and h5py only.
"""

__version__ = "0.1.0"
