"""Drivers in processes of their own.

A vendor's library may hang holding Python's lock, crash, or print; in a child process it does so alone. ``hosted`` turns any
driver into one that lives in a child::

    DRIVERS = {"tof": hosted("tof", "mycamera.driver:MyTof", {"capture": 20.0})}

Linux only: it uses ``memfd_create`` and sequenced-packet sockets.
"""

from tofcapture.devices.host.device import HostedArm, HostedDevice, HostedStereo, HostedTof, hosted

__all__ = ["HostedArm", "HostedDevice", "HostedStereo", "HostedTof", "hosted"]
