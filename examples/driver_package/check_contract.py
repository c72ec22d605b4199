"""Find the installed driver as a station does, and put it through the contract."""

from pathlib import Path

from tofcapture.devices.registry import StationContext, make_device
from tofcapture.testing import check_tof

CONTEXT = StationContext({"tof": {"driver": "acme", "serial": "A-0042"}}, Path())

if __name__ == "__main__":
    check_tof(lambda: make_device("tof", CONTEXT))
    print("acme keeps the contract")
