"""Planes of symmetry, where control points may sit, and what meshes are like: their edges, pieces, pairs and blocks."""
