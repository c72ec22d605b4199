"""Find where a camera sits on the hand, or beside the arm; :mod:`calibration.hand_eye.solve` tells the story."""

from tofcapture.libraries import called

called(__name__, "calibration.hand_eye.solve:solve_hand_eye")
