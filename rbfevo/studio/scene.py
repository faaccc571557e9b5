"""What the browser draws: the painted surface, and the control points of a setup. No picture is made on this side."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Points, Triangles
from rbfevo.geometry import topology
from rbfevo.meshes.vtk_datasets import polydata

CLAY, PULLED, PUSHED, HELD = (207, 195, 180), (178, 24, 43), (33, 102, 172), (70, 70, 70)
CENTER, CHOSEN, IMAGE = (224, 32, 27), (11, 79, 168), (242, 160, 158)
SIZE = 0.011  # of the diagonal: radius of a control point


class Scene:
    """A VTK scene that is sent to the browser.

    Args:
        vertices: [n, 3] model units; triangles: [f, 3]; up: the axis that is up.
    """

    def __init__(self, vertices: Points, triangles: Triangles, up: str) -> None:
        from vtkmodules.vtkRenderingCore import vtkRenderer

        self._triangles = triangles
        self._shown: Points | None = None  # what the surface has now, and whether its normals are those of it
        self._smooth = True
        self._painted: NDArray[np.uint8] | None = None
        self.diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self._surface = polydata(vertices.astype(np.float32), triangles, {})
        self._points = polydata(np.zeros((1, 3)), None, {})
        self.renderer = vtkRenderer()
        self.renderer.SetBackground(1.0, 1.0, 1.0)
        self._actor = self._added(self._surface)
        self._centers = self._added(self._points)
        self.window = _window()
        self.window.AddRenderer(self.renderer)
        self.show(vertices)
        self._ball = _ball()
        self.show_centers(np.empty((0, 3)))
        self._look_from(vertices, "xyz".index(up))

    def _added(self, dataset: Any) -> Any:
        """An actor of a dataset that is coloured by its array `colors`."""
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

        mapper, actor = vtkPolyDataMapper(), vtkActor()
        mapper.SetInputData(dataset)
        mapper.SetScalarModeToUsePointFieldData()
        mapper.SelectColorArray("colors")
        mapper.SetColorModeToDirectScalars()
        mapper.SetScalarVisibility(1)
        actor.SetMapper(mapper)
        actor.GetProperty().SetSpecular(0.1)
        self.renderer.AddActor(actor)
        return actor

    def _look_from(self, vertices: Points, up: int) -> None:
        """Put the camera where all of the surface is seen, from the front and a little from above."""
        middle, camera = vertices.min(axis=0) + np.ptp(vertices, axis=0) / 2.0, self.renderer.GetActiveCamera()
        direction, upwards = np.full(3, -0.9), np.zeros(3)
        direction[(up + 1) % 3], direction[(up + 2) % 3], direction[up] = -0.55, -0.95, 0.5
        upwards[up] = 1.0
        camera.SetFocalPoint(*middle)
        camera.SetPosition(*(middle + 1.6 * self.diagonal * direction / np.linalg.norm(direction)))
        camera.SetViewUp(*upwards)
        self.renderer.ResetCameraClippingRange()

    def show(self, vertices: Points, smooth: bool = True) -> None:
        """Let the surface have these vertices [n, 3].

        Args:
            smooth: whether normals are computed anew, which takes longer than the rest.
        """
        from vtkmodules.util.numpy_support import numpy_to_vtk

        same = self._shown is not None and np.array_equal(vertices, self._shown)
        if same and (self._smooth or not smooth):
            return  # what has not changed is not sent again
        self._shown, self._smooth = vertices.copy(), smooth
        self._surface.GetPoints().SetData(numpy_to_vtk(np.ascontiguousarray(vertices, np.float32), deep=True))
        if smooth:
            normals = topology.vertex_normals(vertices, self._triangles).astype(np.float32)
            array = numpy_to_vtk(normals, deep=True)
            array.SetName("Normals")
            self._surface.GetPointData().SetNormals(array)
        self._surface.Modified()

    def paint(self, colors: NDArray[np.uint8]) -> None:
        """Let the surface have these colours [n, 3]."""
        if self._painted is None or not np.array_equal(colors, self._painted):
            self._painted = colors.copy()
            _colored(self._surface, colors)

    def show_centers(self, centers: Points, images: NDArray[np.bool_] | None = None, held: int | None = None) -> None:
        """Draw control points [q, 3] as balls, mirror images paler; `held` is the one that is pulled."""
        from vtkmodules.util.numpy_support import numpy_to_vtk

        corners, triangles = self._ball
        q = len(centers)
        colors = np.tile(np.array(CENTER, np.uint8), (q, 1))
        if images is not None:
            colors[images] = IMAGE
        if held is not None and held < q:
            colors[held] = CHOSEN
        places = (centers[:, None] + SIZE * self.diagonal * corners).reshape(-1, 3)
        faces = (triangles + (len(corners) * np.arange(q))[:, None, None]).reshape(-1, 3)
        made = polydata(places.astype(np.float32), faces if q else np.empty((0, 3), np.int64), {})
        normals = numpy_to_vtk(np.tile(corners.astype(np.float32), (q, 1)).reshape(-1, 3), deep=True)
        normals.SetName("Normals")
        made.GetPointData().SetNormals(normals)
        _colored(made, np.repeat(colors, len(corners), axis=0))
        self._points.ShallowCopy(made)
        self._centers.SetVisibility(q > 0)
        self._points.Modified()


def _window() -> Any:
    """A window that is never drawn in; that there is no display to open it on is no news."""
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401 - the factory of what follows
    from vtkmodules.vtkCommonCore import vtkLogger
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        window = vtkRenderWindow()
        window.SetOffScreenRendering(1)
    finally:
        vtkLogger.SetStderrVerbosity(before)
    return window


def _colored(dataset: Any, colors: NDArray[np.uint8]) -> None:
    """Give a dataset the array `colors`."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(colors, np.uint8), deep=True)
    array.SetName("colors")
    dataset.GetPointData().SetScalars(array)
    dataset.Modified()


def _ball() -> tuple[Array, Array]:
    """Corners [v, 3] of a unit sphere, and its triangles."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def colors_of(field: Points, normals: Points, held: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colours [n, 3] of a painted field [n, 3]: red where it goes outwards, blue inwards, dark where vertices stay."""
    size = np.linalg.norm(field, axis=1)
    share = np.sqrt(size / (float(size.max(initial=0.0)) or 1.0))[:, None]
    outwards = ((field * normals).sum(axis=1) >= 0.0)[:, None]
    full = np.where(outwards, np.array(PULLED), np.array(PUSHED))
    mixed = (1.0 - share) * np.array(CLAY) + share * full
    return np.where(held[:, None], np.array(HELD), mixed).round().astype(np.uint8)
