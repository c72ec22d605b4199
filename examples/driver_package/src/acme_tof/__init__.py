"""The driver ``acme``: registered in pyproject.toml, found by tofcapture by its entry point."""

from tofcapture.devices.host import hosted

# The second argument is what the child process imports; this module imports no vendor's library.
DRIVERS = {"tof": hosted("tof", "acme_tof.camera:AcmeTof", {"capture": 20.0})}
