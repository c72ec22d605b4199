"""The child process of a driver: ``python -m tofcapture.devices.host DESCRIPTOR``."""

from tofcapture.devices.host.child import main

main()
