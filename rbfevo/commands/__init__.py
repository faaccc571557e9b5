"""The command line: its arguments become runs and sweeps, or one clear error message."""
