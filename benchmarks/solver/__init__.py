"""What the setups of rbfevo and their competitors bring to a real solver, by adjoint solution."""
