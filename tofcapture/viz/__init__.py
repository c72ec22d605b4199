"""Draw whatever people look at: recordings, shards and calibrations in Rerun or on a sheet, figures, plans and pages.

Each kind of file becomes a :class:`tofcapture.viz.shots.Source` of shots; the Rerun recording and the sheet know shots only.
"""

from tofcapture.viz.open import open_source

__all__ = ["open_source"]
