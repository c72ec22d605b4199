"""An emulator of a Universal Robots controller: RTDE, dashboard, script ports, joint motion, and faults on demand.

::

    python -m tests.ur_emulator --host 127.0.0.2

It listens on loopback addresses only. The ``ur_rtde`` client library has fixed ports, so that several emulators stand on
several addresses: 127.0.0.2, 127.0.0.3 ... It knows nothing of URScript: a program whose text mentions ``rtde_control`` is
taken for the library's control script and its register handshake is played.
"""
