"""The command line: what is typed becomes runs and sweeps, and one clear line where it cannot."""
