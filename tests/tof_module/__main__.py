"""Run the simulated module: ``python -m tests.tof_module``."""

from tests.tof_module.module import main

main()
