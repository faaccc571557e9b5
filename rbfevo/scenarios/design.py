"""A template as a design: triangles wound alike, or a curve; normals, areas and mass of its vertices."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray

from rbfevo.arrays import Ints, Points, Triangles
from rbfevo.geometry import topology
from rbfevo.geometry.parameterization import Region
from rbfevo.geometry.rims import Rim, rim_of, rim_of_curve
from rbfevo.scenarios import signs
from rbfevo.scenarios.outline import outline
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.sampling import curve_sampler, open_parts, surface_sampler
from rbfevo.scenarios.scenario import Sampler
from rbfevo.scenarios.signs import Sides
from rbfevo.scenarios.templates import Template


@dataclasses.dataclass(frozen=True)
class Design:
    """A template's consistently wound triangles or segments; normals [n, 3], areas and mass [n] of its vertices.

    Of a curve areas are lengths. `surface` is what the closest points lie on: of a curve the strip that it sweeps.
    """

    vertices: Points
    triangles: Triangles
    segments: Ints
    normals: Points
    areas: NDArray[np.float64]
    mass: NDArray[np.float64]
    surface: tuple[Points, Triangles]

    @staticmethod
    def of(template: Template, weights: str, flat: Planar | None = None) -> tuple[Design, dict[str, str]]:
        """The design of a template, and notes on the oddities of its surface or curve."""
        vertices, triangles, segments = template.vertices, template.triangles, template.segments
        if template.curve and flat is not None:
            segments, turned, normals, areas, surface, notes = outline(vertices, segments, flat.plane)
        else:
            edges = topology.edges_of(len(vertices), triangles)
            notes = topology.oddities(vertices, triangles, edges)
            triangles, turned = topology.oriented(vertices, triangles, edges)
            surface, areas = (vertices, triangles), topology.vertex_areas(vertices, triangles)
            areas = areas if flat is None else flat.averaged(areas)
            normals = (topology.vertex_normals if flat is None else flat.normals)(vertices, triangles)
        if turned:
            parts = "segments" if template.curve else "triangles"
            notes["winding"] = f"{turned} {parts} were turned, so that all normals point to the same side"
        mass = areas / areas.mean() if weights == "area" else np.ones(len(areas))
        return Design(vertices, triangles, segments, normals, areas, mass, surface), notes

    def rim(self, flat: Planar | None) -> Rim:
        """Its open boundary: of a slab without front and back, of a curve its ends."""
        if len(self.segments):
            return rim_of_curve(self.vertices, self.segments)
        return rim_of(self.vertices, self.triangles, None if flat is None else flat.plane.axis)

    def sampler(self, region: Region | None) -> Sampler:
        """Centers uniform on the surface or the curve, outside a region."""
        vertices, curve = torch.from_numpy(self.vertices), len(self.segments) > 0
        parts = open_parts(vertices, torch.from_numpy(self.segments if curve else self.triangles), region)
        return (curve_sampler if curve else surface_sampler)(vertices, parts)

    def sides(self, template: Template, flat: Planar | None) -> Sides:
        """The outward normals of its vertices, and those of the template's file."""
        if template.curve and flat is not None:
            return signs.sides_of_curve(template.vertices, template.segments, self.normals, flat.plane)
        normals = topology.vertex_normals if flat is None else flat.normals
        return signs.sides(template.vertices, template.triangles, normals)

    @property
    def elements(self) -> Ints:
        """The triangles [f, 3], or of a curve the segments [s, 2]."""
        return self.segments if len(self.segments) else self.triangles
