"""The paper's results made again, and put to the test: `scripts/reproduce`."""
