"""systemd: tell it how we are, and the unit to install."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

UNIT = """\
[Unit]
Description=tofcapture: capture daemon
After=network.target
StartLimitIntervalSec=120
StartLimitBurst=5

[Service]
Type=notify
NotifyAccess=main
ExecStart={program} daemon --root {root} --state {state}
User={user}
Restart=on-failure
RestartSec=2
WatchdogSec=20
# The daemon stops the arm and ends within 5 s. Recorder and driver hosts ignore the signal: they hear from the daemon,
# or, when it is dead, stop the arm by themselves; "mixed" would kill them before they can.
KillMode=control-group
TimeoutStopSec=20
UMask=0077
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
ReadWritePaths={root} {state} /tmp
PrivateTmp=no
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
LockPersonality=yes
RestrictRealtime=no
# A serial module: DeviceAllow=/dev/ttyACM0 rw

[Install]
WantedBy=multi-user.target
"""


def unit(root: Path, state: Path) -> str:
    """The unit file; it never allows motion of a real arm, that is given anew by a person."""
    import getpass

    program = f"{sys.executable} -m tofcapture"
    return UNIT.format(program=program, root=root.resolve(), state=state.resolve(), user=getpass.getuser())


def notify(*lines: str) -> bool:
    """Send lines (``READY=1`` ...) to systemd; false when it did not start us, or does not listen."""
    where = os.environ.get("NOTIFY_SOCKET")
    if not where:
        return False
    address = "\0" + where[1:] if where.startswith("@") else where
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
            link.connect(address)
            link.send("\n".join(lines).encode())
    except OSError:
        return False
    return True


def watchdog_period() -> float | None:
    """Seconds between signs of life that systemd wants (half its limit), ``None`` when it wants none."""
    limit = os.environ.get("WATCHDOG_USEC", "")
    meant = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    return int(limit) / 2e6 if limit.isdigit() and int(limit) and meant else None
