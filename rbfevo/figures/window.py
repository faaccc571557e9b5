"""The scene of `python -m rbfevo.show` in PyVista: in a window, or off-screen as a picture.

VTK starts OpenGL, and crashes if there is none: `rbfevo.show` runs this module in a separate process.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from matplotlib.image import imsave
from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTrackballCamera

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.figures import style
from rbfevo.figures.pane import Pane
from rbfevo.figures.scene import COLOURS, KEYS, SHAPES, SOFTWARE, Fields, State
from rbfevo.figures.view import standpoint, view_of
from rbfevo.files import write_whole
from rbfevo.recorded.record import Record

SIZE = (1200, 860)  # pixels
LOW, HIGH = 0.14, 0.86  # the part of the window's height for the setups; texts and slider are outside it
PLACES = (1, 2)  # of the renderers of setups, in the plotter; the first one, behind them, has texts and slider
LIVE = 50_000  # vertices up to which the scene follows the slider while it is dragged
WINDOWLESS = ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")


class Window:
    """The scene of one run, on the screen or off it.

    Attributes:
        state: what is shown; plotter: PyVista's.
    """

    def __init__(self, run: Path, record: Record, state: State, *, off_screen: bool) -> None:
        """Build the scene.

        Raises:
            RuntimeError: if there is no display to open a window on.
        """
        self.state, self._run = state, run
        self._of_each = [Fields(alone) for alone in record.each()]
        self.plotter: Any = pyvista.Plotter(shape=(1, 3), border=False, off_screen=off_screen, window_size=list(SIZE))
        kind = self.plotter.render_window.GetClassName()
        if not off_screen and kind in WINDOWLESS:  # VTK would warn, go on without a window and wait forever
            raise RuntimeError(f"the display cannot be opened (VTK offers only {kind})")
        self.plotter.background_color = pyvista.Color("white")
        self._panes = [Pane(self.plotter, place, record, self._fields) for place in PLACES]
        self._stand(record)
        self._write_texts()
        self._slider: Any = None
        self.plotter.enable_anti_aliasing("msaa", multi_samples=8)
        self._redraw()
        if off_screen:
            self.plotter.show(auto_close=False)

    @property
    def _fields(self) -> Fields:
        """Those of the objective that is shown."""
        return self._of_each[self.state.objective]

    def open(self) -> None:
        """Open the window and return when it is closed."""
        self._add_slider()
        self._listen()
        self._redraw()
        self.plotter.show(title=f"rbfevo: {self._run}", auto_close=True)

    def press(self, key: str) -> None:
        """Carry out the action of a key (`rbfevo.figures.scene.KEYS`)."""
        try:
            if key in ("q", "Escape"):
                self.plotter.iren.terminate_app()
                return
            if key == "v":
                self._look()
            elif key == "s":
                self.state.message = f"written: {self.save()}"
            elif not self.state.press(key):
                return
        except UserError as error:
            self.state.message = str(error)
        self._redraw()
        self.plotter.render()

    def slide(self, preference: float) -> None:
        """Show the setup for a preference."""
        self.state.prefer(preference)
        self._redraw()

    def save(self) -> Path:
        """Write a picture beside the run, under a name that is not taken, and return where.

        Raises:
            UserError: if it cannot be written.
        """
        stem = "show-row-" + "-vs-".join(map(str, self.state.rows))
        names = (f"{stem}{'' if count == 1 else f'-{count}'}.png" for count in range(1, 10_000))
        path = next(self._run / name for name in names if not (self._run / name).exists())
        write_whole(path, png(self.picture(bare=True)))
        return path

    def picture(self, bare: bool = False) -> Array:
        """The scene as it is shown, [height, width, 3] uint8; `bare` without slider, keys and messages.

        Raises:
            RuntimeError: if the rendering stays empty, as it does with some broken OpenGL drivers.
        """
        if bare:
            self._decorate(False)
        self.plotter.render()
        image = np.asarray(self.plotter.screenshot(return_img=True))[..., :3]
        if bare:
            self._decorate(True)
        if image.std() == 0:
            raise RuntimeError("OpenGL rendered an empty picture")
        return image

    def _stand(self, record: Record) -> None:
        """Lights, and one camera for both panes, so that they turn together."""
        plotter, state = self.plotter, self.state
        shapes = [self._fields.points(0, "template")]
        if state.can("shape", "wanted"):
            shapes.append(self._fields.points(0, "wanted"))
        points = np.concatenate([*shapes, self._fields.centers(state.row, "template")[0]])
        view = view_of(points, 2 * self._fields.radius, *standpoint(record))
        self._half = np.abs(view.project(points)[0]).max(axis=0) + 2 * self._fields.radius
        self._view, self._scale = view, 0.0
        camera = plotter.renderers[1].camera
        camera.parallel_projection = True
        self._look()
        for renderer in plotter.renderers[1:]:
            renderer.camera = camera
            renderer.camera_set = True
            renderer.remove_all_lights()
            for tilt, intensity in (((-0.4, 0.5, 1.0), 0.6), ((0.5, 0.0, 1.0), 0.4)):
                light = pyvista.Light(position=tilt, intensity=intensity, light_type="camera light")
                renderer.add_light(light)
        plotter.renderers[0].viewport = (0.0, 0.0, 1.0, 1.0)
        plotter.renderers[0].SetInteractive(False)

    def _look(self) -> None:
        """Put the camera back to its first place."""
        camera, view = self.plotter.renderers[1].camera, self._view
        camera.focal_point = tuple(view.focus)
        camera.position = tuple(view.focus + 10 * view.half * view.towards)
        camera.up = tuple(view.up)
        self._scale = 0.0

    def _write_texts(self) -> None:
        plotter, dark, grey = self.plotter, style.INK, style.GREY

        def text(x: float, y: float, size: int, colour: str, content: str = "") -> Any:
            made = plotter.add_text(content, position=(x, y), viewport=True, font_size=size, color=colour)
            made.prop.SetLineSpacing(1.2)
            return made

        plotter.subplot(0, 0)
        title = text(0.02, 0.965, 10, dark, self.state.record.title)
        title.prop.bold = True
        self._subtitle, self._message = text(0.02, 0.935, 8, grey), text(0.02, 0.008, 9, style.MAGENTA)
        self._heads = [text(0.02, 0.875, 9, dark), text(0.52, 0.875, 9, dark)]
        plotter.subplot(0, PLACES[0])  # over the setup
        self._keys = text(0.02, 0.03, 9, dark, "\n".join(f"{keys}: {what}" for keys, what in KEYS))
        self._keys.prop.background_color, self._keys.prop.background_opacity = "white", 0.85
        plotter.subplot(0, 0)
        self._measured = text(0.55, 0.107, 9, dark)
        plotter.add_scalar_bar(
            title=" ",
            mapper=self._panes[0].surface.mapper,
            n_labels=5,
            vertical=False,
            fmt="%.3g",
            width=0.42,
            height=0.06,
            position_x=0.55,
            position_y=0.035,
            color=dark,
            label_font_size=14,
            unconstrained_font_size=True,
        )

    def _add_slider(self) -> None:
        self.plotter.subplot(0, 0)
        live = len(self.state.record.vertices) <= LIVE
        self._slider = self.plotter.add_slider_widget(
            lambda value: None if self._slider is None else self.slide(value),  # PyVista calls it once too early
            (0.0, 1.0),
            value=self.state.preference,
            title=" ",
            pointa=(0.03, 0.085),
            pointb=(0.45, 0.085),
            style="modern",
            color=style.INK,
            title_height=0.018,
            fmt="%.2f",
            interaction_event="always" if live else "end",
        )

    def _listen(self) -> None:
        """Handle all keys here, instead of PyVista's and VTK's own actions."""
        self._slider.KeyPressActivationOff()  # i
        interaction: Any = vtkInteractorStyleTrackballCamera()
        interaction.AddObserver("CharEvent", lambda *_: None)  # instead of VTK's own e, f, p, q, r, s, u, w, 3
        inner = self.plotter.iren
        inner.style = interaction
        inner.clear_key_event_callbacks()
        inner.add_observer("KeyPressEvent", lambda *_: self._key_pressed(inner.interactor.GetKeySym()))

    def _key_pressed(self, key: str | None) -> None:
        if key:
            self.press(key if len(key) > 1 else key.lower())

    def _decorate(self, on: bool) -> None:
        """Show or hide the parts that belong to a window and not to a picture."""
        self._message.SetVisibility(on)
        self._keys.SetVisibility(on and self.state.keys_shown)
        if self._slider is not None:
            self._slider.GetRepresentation().SetVisibility(on)

    def _redraw(self) -> None:
        """Update everything to the state."""
        state, fields = self.state, self._fields
        rows = state.rows
        for place, renderer in enumerate(self.plotter.renderers[1:]):
            shown = place < len(rows)
            left, right = place / len(rows), (place + 1) / len(rows)
            renderer.viewport = (left, LOW, right, HIGH) if shown else (0.0, 0.0, 0.001, 0.001)
            renderer.SetDraw(shown)
            self._heads[place].SetVisibility(shown)
            if shown:
                self._panes[place].show(rows[place], state.colour, state.shape, fields)
                self._heads[place].input = "\n".join(state.titles(rows[place]))
        width, height = self.plotter.window_size
        wide = width / len(rows) / (height * (HIGH - LOW))  # width of a pane over its height
        scale = float(max(self._half[1], self._half[0] / wide))
        camera = self.plotter.renderers[1].camera
        camera.parallel_scale = camera.parallel_scale * scale / self._scale if self._scale else scale  # keeps a zoom
        self._scale = scale
        self._subtitle.input = self._description()
        of = f" for {state.record.objectives[state.objective]}" if state.record.objectives else ""
        self._measured.input = f"{COLOURS[state.colour]}{of} {fields.unit}"
        self._message.input = state.message or ("" if state.keys_shown else "h: keys")
        self._decorate(True)
        if self._slider is not None:
            self._slider.GetRepresentation().SetValue(state.preference)
            self._slider.GetRepresentation().SetTitleText(state.slider_title())
        for renderer in self.plotter.renderers[1:]:
            renderer.ResetCameraClippingRange()

    def _description(self) -> str:
        """What is drawn, in a line."""
        state, record = self.state, self.state.record
        remark = f" ({self._fields.remark})" if state.shape != "template" and self._fields.remark else ""
        images = ", their mirror images in light red" if record.summary.get("symmetry") is not None else ""
        moved = ", at their moved places" if state.shape == "reached" else ""
        m = record.centers.shape[1]
        return f"{SHAPES[state.shape]}{remark}; {m} center{'s' * (m != 1)} in red{moved}{images}"


def png(image: Array) -> bytes:
    """A picture [height, width, 3] uint8 as the bytes of a PNG that names its software."""
    written = io.BytesIO()
    imsave(written, image, format="png", metadata={"Software": SOFTWARE})
    return written.getvalue()
