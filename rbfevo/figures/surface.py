"""One 3-D panel: a coloured surface and its centers, rendered by OpenGL, or by matplotlib where there is none."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

from rbfevo.arrays import Array
from rbfevo.figures import style
from rbfevo.figures.view import View, hidden

PIXELS = 540  # as many as the panel has on paper
GHOST = 0.4  # opacity of centers behind the surface
FEW = 2000  # vertices of a cloud or curve, up to which they are drawn as larger points
AMBIENT, DIFFUSE = 0.45, 0.62  # shares of the light: what shades nothing, and what shades the surface


def render(
    axes: Axes,
    view: View,
    vertices: Array,
    faces: Array,
    colors: Array,
    centers: Array,
    radius: float,
    ambient: float = AMBIENT,
    balls: Array | None = None,
) -> None:
    """Show a surface with colours [n, 3] and balls at `centers` [m, 3], an off-screen rendering by PyVista.

    Balls have the colours `balls` [m, 3], dark or red; all are red unless given. Those behind the surface shine
    through: they are blended over it. The larger the share `ambient` of the light, the closer the picture keeps to
    `colors`.

    Raises:
        RuntimeError: if the rendering stays empty, as it does with some broken OpenGL drivers.
    """
    import pyvista  # VTK starts OpenGL: in this function only, in a process of its own

    plotter = pyvista.Plotter(off_screen=True, window_size=[PIXELS, PIXELS], lighting="none")
    plotter.background_color = pyvista.Color("white")
    for tilt, intensity in (
        (view.towards + 0.5 * view.up - 0.4 * view.right, 0.6),
        (view.towards + 0.5 * view.right, 0.4),
    ):
        plotter.add_light(pyvista.Light(position=tuple(tilt), focal_point=(0, 0, 0), intensity=intensity))
    plotter.camera.position = tuple(view.focus + 10 * view.half * view.towards)
    plotter.camera.focal_point = tuple(view.focus)
    plotter.camera.up = tuple(view.up)
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = view.half
    mesh = pyvista.PolyData.from_regular_faces(vertices, faces) if len(faces) else pyvista.PolyData(vertices)
    surface = plotter.add_mesh(
        mesh,
        scalars=np.round(255 * colors).astype(np.uint8),
        rgb=True,
        smooth_shading=bool(len(faces)),
        ambient=ambient,
        diffuse=AMBIENT + DIFFUSE - ambient,
        specular=0.05,
        point_size=4 if len(vertices) > FEW else 9,
        show_scalar_bar=False,
    )
    plotter.enable_anti_aliasing("ssaa")
    plotter.reset_camera_clipping_range()
    plotter.show(auto_close=False)
    bare = _pixels(plotter)
    if bare.std() == 0:
        plotter.close()
        raise RuntimeError("OpenGL rendered an empty picture")
    if len(centers):
        cloud: Any = pyvista.PolyData(centers)
        cloud["colour"] = np.round(255 * _of_balls(centers, balls)).astype(np.uint8)
        glyphs = cloud.glyph(geom=pyvista.Sphere(radius=radius), scale=False, orient=False)
        look: Any = {"smooth_shading": True, "ambient": 0.45, "diffuse": 0.6, "specular": 0.2}
        plotter.add_mesh(glyphs, scalars="colour", rgb=True, render=False, **look)
        plotter.reset_camera_clipping_range()
        plotter.render()
        whole = _pixels(plotter)
        surface.SetVisibility(False)
        plotter.render()
        alone = _pixels(plotter)
        ball = alone[..., 2:] < 0.5  # red or dark, without the rim that blends into the white around it
        seen = (whole != bare).any(axis=2, keepdims=True)
        bare = np.where(ball & ~seen, (1 - GHOST) * bare + GHOST * alone, whole)
    plotter.close()
    axes.imshow(bare, extent=(-view.half, view.half, -view.half, view.half), interpolation="antialiased")


def project(
    axes: Axes,
    view: View,
    vertices: Array,
    faces: Array,
    colors: Array,
    centers: Array,
    radius: float,
    ambient: float = AMBIENT,
    balls: Array | None = None,
) -> None:
    """Show the same by matplotlib alone: faces painted from back to front, with the light from the camera's left."""
    flat, near = view.project(vertices)
    if len(faces):
        order = np.argsort(near[faces].mean(axis=1), kind="stable")
        corners = vertices[faces[order]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        light = view.towards + 0.6 * view.up - 0.5 * view.right
        shade = ambient + (AMBIENT + DIFFUSE - ambient) * np.abs(normals @ (light / np.linalg.norm(light)))
        shown = np.clip(colors[faces[order]].mean(axis=1) * shade[:, None], 0, 1)
        axes.add_collection(
            PolyCollection(list(flat[faces[order]]), facecolors=shown, edgecolors=shown, linewidths=0.25)
        )
        behind = hidden(centers, vertices, faces, view)
    else:
        order = np.argsort(near, kind="stable")
        axes.scatter(*flat[order].T, c=colors[order], s=2 if len(vertices) > FEW else 8, linewidths=0)
        behind = np.zeros(len(centers), dtype=bool)
    points_per_unit = axes.bbox.width * 72 / axes.figure.dpi / (2 * view.half)
    places = view.project(centers)[0]
    for which, opacity, edge in ((behind, GHOST, "none"), (~behind, 1.0, "white")):
        own = np.insert(_of_balls(centers, balls)[which], 3, opacity, axis=1)
        size = (2 * radius * points_per_unit) ** 2
        axes.scatter(*places[which].T, s=size, facecolor=own, edgecolor=edge, linewidth=0.4, zorder=3)


def _of_balls(centers: Array, balls: Array | None) -> Array:
    """Colours [m, 3] in [0, 1]."""
    return np.tile(to_rgb(style.RED), (len(centers), 1)) if balls is None else balls


def _pixels(plotter: Any) -> Array:
    """Return what the plotter shows, [PIXELS, PIXELS, 3] in [0, 1]."""
    return np.asarray(plotter.image, dtype=float)[..., :3] / 255.0
