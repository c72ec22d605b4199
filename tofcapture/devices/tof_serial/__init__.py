"""A ToF module on a serial link: our framing and a driver; docs/serial-protocol.md is the reference.

::

    [tof]
    driver = "tof_serial"
    port = "/dev/serial/by-id/usb-..."
"""

from tofcapture.devices.host import hosted

# Ten frames take a minute on a UART of 921,600 baud; a link that stands still is noticed long before.
DRIVERS = {
    "tof": hosted(
        "tof", "tofcapture.devices.tof_serial.driver:SerialTof", {"__enter__": 20.0, "capture": 900.0}
    )
}
