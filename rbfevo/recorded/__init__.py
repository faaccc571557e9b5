"""What run directories hold, read without torch: setups, picks, sweeps."""
