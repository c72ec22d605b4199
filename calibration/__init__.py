"""Calibrate a rig: align the two cameras, and say how well they are aligned.

::

    rig, evidence = calibration.align("recording")
    found = calibration.hand_eye(T_base_flange, T_camera_target)

Importing this package loads nothing else.
"""

from typing import TYPE_CHECKING

from tofcapture.libraries import face as _face

if TYPE_CHECKING:
    from calibration.align import align
    from calibration.hand_eye.solve import solve_hand_eye as hand_eye

__all__ = ["align", "hand_eye"]
__getattr__, __dir__ = _face(__name__, {"align": "align", "hand_eye": "hand_eye.solve:solve_hand_eye"})
