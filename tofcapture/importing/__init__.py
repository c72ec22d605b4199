"""Turn what others wrote into a recording: arrays, images, bags, raw frames of cameras.

:func:`tofcapture.importing.views.import_data` is the whole way; :mod:`tofcapture.importing.source` says what a reader is.
"""
