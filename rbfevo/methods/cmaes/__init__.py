"""The search for one setup per preference by CMA-ES: the algorithm, and its settings."""
