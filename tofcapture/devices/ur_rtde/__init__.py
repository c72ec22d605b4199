"""Universal Robots arms: a handshake probe in plain Python, then the ``ur_rtde`` library in a process of its own."""
