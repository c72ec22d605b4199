"""A simulated ToF module that speaks docs/serial-protocol.md: for our tests, and to hold other hosts against."""
