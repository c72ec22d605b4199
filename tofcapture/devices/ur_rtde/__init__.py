"""Universal Robots arms: a handshake probe in plain Python, then the ``ur_rtde`` library in a process of its own."""

from tofcapture.devices.faults import ControllerSilent
from tofcapture.devices.host import hosted

# The slowest motion, with the speed slider at a tenth, takes minutes; everything else is noticed within it.
_DEADLINES = {"__enter__": 8.0, "move_to": 600.0}

DRIVERS = {"arm": hosted("arm", "tofcapture.devices.ur_rtde.arm:UrArm", _DEADLINES, overdue=ControllerSilent)}
