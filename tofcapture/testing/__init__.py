"""For those who write drivers: checks that any driver must pass."""

from tofcapture.testing.contract import ContractError, check_arm, check_operator, check_stereo, check_tof

__all__ = ["ContractError", "check_arm", "check_operator", "check_stereo", "check_tof"]
