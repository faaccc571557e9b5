"""Run directories read back without torch: setups, picks, sweeps."""
