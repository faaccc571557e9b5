"""Reproduces the paper's results and tests its claims: `scripts/reproduce`."""
