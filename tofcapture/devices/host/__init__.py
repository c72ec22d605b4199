"""Drivers in processes of their own.

A vendor's library may hang holding Python's lock, crash, or print; in a child process it does so alone. ``hosted`` turns
any driver into one that lives in a child::

    DRIVERS = {"tof": hosted("tof", "mycamera.driver:MyTof", {"capture": 20.0})}

Not for Windows: the child inherits the descriptor of its end of the connection.
"""

from tofcapture.devices.host.device import HostedDevice, hosted

__all__ = ["HostedDevice", "hosted"]
