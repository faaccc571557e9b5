"""Gmsh's MSH format, versions 2 and 4, in text and binary: coordinates are put in place, all other bytes stay."""

from rbfevo.meshes.gmsh.reader import read_gmsh

__all__ = ["read_gmsh"]
