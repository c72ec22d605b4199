"""What can go wrong with a module on a serial link; every one is a :class:`DeviceError` that says what to do."""

from __future__ import annotations

from tofcapture.errors import DeviceError


class LinkLostError(DeviceError):
    """The port is gone: a pulled cable, a module without power, another process on the port."""


class ModuleSilentError(DeviceError):
    """The port is open but nobody answers."""


class LinkTooBadError(DeviceError):
    """The link loses so much that a frame cannot be completed, or answers never arrive."""


class ModuleResetError(DeviceError):
    """The module started anew in the middle of the work; its burst is gone."""


class FirmwareError(DeviceError):
    """The module's firmware or protocol is not one that this host, or this station, works with."""


class ModuleRefusedError(DeviceError):
    """The module says no, or says something that the protocol does not allow."""


class ClockError(DeviceError):
    """The module's clock jumps or drifts beyond what a crystal does."""
