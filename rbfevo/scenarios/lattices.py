"""Lattices that somebody has placed: read from files, without torch."""

from __future__ import annotations

from rbfevo.meshes.lattices import LatticeFile, read_lattice

__all__ = ["LatticeFile", "read_lattice"]
