"""Every error that tofcapture raises on purpose.

::

    TofError                 exit code 1   anything below
    ├── UsageError           2             the command line does not make sense
    ├── ConfigError          3             a TOML file, an option or a value is wrong
    ├── DeviceError          4             a device is missing, silent or refuses
    │   └── MotionRefused    4             the arm must not or cannot go there
    │       └── MotionStopped                somebody told it to stop
    ├── DataError            5             a file is missing, damaged, foreign, or says something impossible
    │   ├── FormatError      5             a file's layout is not the one its version promises
    │   └── UnreadableError  5             a file cannot be read just now (lock, permission, disk); that is no damage
    ├── QualityError         6             a gate refused a result (registration, coverage, ground truth)
    └── BusyError            7             someone else holds the recording or the station

Exit code 0 is success, 130 an interruption by the user. A message says what was expected, what was found, and
where; ``hint`` says what to try next.
"""

from __future__ import annotations


class TofError(Exception):
    """Base of the tree: a message (expected, got, where) and a hint (what to try next), one sentence each."""

    exit_code = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


class UsageError(TofError):
    """The command line does not make sense."""

    exit_code = 2


class ConfigError(TofError):
    """A TOML file, an option or a value is wrong."""

    exit_code = 3


class DeviceError(TofError):
    """A device is missing, silent or refuses."""

    exit_code = 4


class MotionRefused(DeviceError):  # noqa: N818  the arm's answer is a refusal, not a fault
    """The arm must not, or cannot, go there."""


class MotionStopped(MotionRefused):
    """Somebody told the arm to stop, and nobody has said since that it may go on."""


class DataError(TofError):
    """A file is damaged, foreign, or says something impossible."""

    exit_code = 5


class FormatError(DataError):
    """A file's layout is not the one its version promises."""


class UnreadableError(DataError):
    """A file cannot be read just now: a lock, a permission, a disk's error. That is no damage."""


class QualityError(TofError):
    """A gate refused a result."""

    exit_code = 6


class BusyError(TofError):
    """Someone else holds the recording or the station."""

    exit_code = 7


class PassedOver(UserWarning):
    """A file among the views of a recording is none of them; the message names it and says why."""
