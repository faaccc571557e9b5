"""Symmetry planes, regions for control points, and properties of meshes: edges, pieces, pairs and blocks."""
