"""One pane of the window of `python -m rbfevo.show`: the template and the centers of one setup, in PyVista."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyvista

from rbfevo.figures import style
from rbfevo.figures.scene import Fields
from rbfevo.figures.surface import AMBIENT, DIFFUSE, GHOST
from rbfevo.recorded.record import Record

IMAGE = "#f2a5a3"  # a mirror image of a center
IN_FRONT = -66_000.0  # as near as OpenGL's depth goes, for the centers that shine through the surface


class Pane:
    """One setup: its surface and its centers, in the renderer `place` of the plotter."""

    def __init__(self, plotter: Any, place: int, record: Record, fields: Fields) -> None:
        plotter.subplot(0, place)
        self._plotter, self._place = plotter, place
        vertices, faces = fields.points(0, "template"), record.faces
        self.mesh = pyvista.PolyData.from_regular_faces(vertices, faces) if len(faces) else pyvista.PolyData(vertices)
        self.mesh["values"] = fields.values(0, "wanted")
        self._shape, self._smooth, self._highest = (), len(faces) > 0, fields.highest
        self.surface = plotter.add_mesh(
            self.mesh,
            scalars="values",
            cmap=style.ERROR,
            clim=(0.0, fields.highest),
            ambient=AMBIENT,
            diffuse=DIFFUSE,
            specular=0.05,
            point_size=4,
            show_scalar_bar=False,
            copy_mesh=False,
        )
        self.surface.prop.interpolation = "Phong"
        self._balls: Any = pyvista.Sphere(radius=fields.radius, theta_resolution=20, phi_resolution=20)

    def show(self, row: int, colour: str, shape: str, fields: Fields) -> None:
        """Show setup `row` in a colouring and a shape, with the displacements of one objective."""
        drawn = shape, row if shape == "reached" else None, None if shape == "template" else id(fields)
        if fields.highest != self._highest:
            self._highest = fields.highest
            self.surface.mapper.scalar_range = (0.0, fields.highest)
        if drawn != self._shape:
            self._shape = drawn
            self.mesh.points = fields.points(row, shape)
            if self._smooth:
                smooth: Any = self.mesh.compute_normals(
                    cell_normals=False, split_vertices=False, consistent_normals=False
                )
                self.mesh.point_data.active_normals = smooth["Normals"]
        self.mesh["values"] = fields.values(row, colour)
        self._plotter.subplot(0, self._place)
        places, mirrored = fields.centers(row, shape)
        colours = np.where(mirrored[:, None], pyvista.Color(IMAGE).int_rgb, pyvista.Color(style.RED).int_rgb)
        cloud = pyvista.PolyData(places)
        cloud["colour"] = colours.astype(np.uint8)
        balls = cloud.glyph(geom=self._balls, scale=False, orient=False)
        for name, opacity in (("centers", 1.0), ("hidden centers", GHOST)):
            actor = self._plotter.add_mesh(
                balls,
                scalars="colour",
                rgb=True,
                opacity=opacity,
                ambient=0.45,
                diffuse=0.6,
                specular=0.2,
                name=f"{name} {self._place}",
                reset_camera=False,
                render=False,
            )
            if opacity < 1:
                actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
                actor.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(0.0, IN_FRONT)
