"""From setups to scores: kernels, the deformation, regularity, improvement potential, their gradients, and fronts."""
