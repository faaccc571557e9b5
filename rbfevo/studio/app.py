"""The program behind the page: it puts painting, search, chosen setup and files together."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.scenarios.targets import paired
from rbfevo.scenarios.templates import Template
from rbfevo.studio import frontier, keeping, layout, saving
from rbfevo.studio.brush import Brush
from rbfevo.studio.follower import Follower
from rbfevo.studio.gestures import Canvas, Gestures
from rbfevo.studio.guard import Guard
from rbfevo.studio.keeping import State
from rbfevo.studio.opening import displacements
from rbfevo.studio.painting import Painting
from rbfevo.studio.picking import Surface
from rbfevo.studio.pulling import Chosen
from rbfevo.studio.scene import Scene, colors_of
from rbfevo.studio.shape import Look
from rbfevo.studio.writer import Writer

if TYPE_CHECKING:
    from rbfevo.studio.searching import Front

KEPT_EVERY = 3.0  # seconds, or longer on large meshes:
SPARING = 10.0  # times what writing takes
ASKED = (
    *("press", "drag", "release", "key", "stop", "clear", "let_go"),
    *("go_on", "begin_anew", "save", "export", "apply"),
)  # what the page asks for, each a method of `Studio`


class Studio:
    """The program behind one page.

    Args:
        state: to begin with; directory: where it is kept; template: of a mesh, with its point arrays, or None.
        host, port: to listen on; 0 for a free port.
    """

    def __init__(self, state: State, directory: Path, template: Template | None, host: str, port: int) -> None:
        from trame_server import Server

        self.directory, self.template, self._address = directory, template, (host, port)
        self.guard = Guard(host)
        self.server = Server(name="rbfevo", client_type="vue3")
        page: Any = self.server.state
        self.page = page
        self.offered: State | None = None
        self._changes, self._kept = 0, 0
        self._begin(state)
        self.scene = Scene(state.vertices, state.triangles, state.choices.up)
        self.gestures = Gestures(Surface(state.vertices, state.triangles), self._canvas, self._gesture_ended)
        self.follower = Follower(page, directory / "searched.vtp", self._found)
        self.writer = Writer(page)
        page.update(layout.variables(state, template, saving.free(directory / "run")))
        page.change(*layout.SEARCHED)(self._choices_changed)
        page.change("share")(self._share_changed)
        page.change("start", "target")(self._start_changed)
        for name in ASKED:
            self.server.controller.trigger(name)(self._answering(getattr(self, name)))
        self._draw()
        self._view, self._plot = layout.lay_out(self.server, self.scene.window, self._answering(self.click))

    def _begin(self, state: State) -> None:
        """Let all be as a state has it."""
        self.state = state
        self.painting = Painting(state.vertices, state.triangles, state.field, state.held)
        self.choices, self.chosen = state.choices, Chosen(state.share)
        self._given = state.centers if len(state.centers) else None
        at = None if state.chosen is None else state.centers[state.chosen]
        self._shown = at, state.moved if at is not None and state.moved.shape == at.shape else None

    def _answering(self, act: Callable[..., Any]) -> Callable[..., Any]:
        """What a window asks for, with a mistake as a line on the page."""

        def answer(*values: Any) -> Any:
            """Carry it out."""
            found = None
            try:
                found = act(*values)
            except UserError as error:
                self.page.problem = str(error)
            self.page.flush()
            return found

        return answer

    # What is shown

    def _draw(self, smooth: bool = True) -> None:
        """Draw surface and control points as they are now.

        Args:
            smooth: whether the normals of a deformed surface are computed anew.
        """
        painting, page, shape = self.painting, self.page, self.chosen.shape
        self.scene.paint(colors_of(painting.field, painting.normals, painting.held))
        if shape is None or page.mode != "pull":
            look, vertices = None, painting.vertices
            places, images = self.chosen.unmoved()
        else:
            look = shape.look(self.chosen.pulls)
            vertices = look.vertices
            places, images = self.chosen.places()
        self.scene.show(vertices, smooth)
        self.scene.show_centers(places, images, self.gestures.held)
        page.undoable, page.redoable = painting.undoable > 0, painting.redoable > 0
        page.painted = bool(painting.field.any() or painting.held.any())
        page.pulled = self.chosen.touched
        page.found, page.facts = shape is not None, self._facts(look)

    def _facts(self, look: Look | None) -> list[list[str]]:
        """What is known of the chosen setup and of its shape, as names and values."""
        record, row = self.chosen.record, self.chosen.row
        if record is None or row is None:
            return []
        facts = [["regularity R", f"{record.regularity[row]:.4g}"]]
        facts += [["improvement potential P", f"{record.potential[row]:.4g}"]]
        facts += [["setup", f"{row + 1} of {len(record.regularity)}"]]
        if look is not None:
            share = 100 * look.farthest / self.painting.diagonal
            facts += [["largest displacement", f"{look.farthest:.4g} ({share:.3g} %)"]]
            facts += [["folded triangles", f"{look.folded} of {len(record.faces)}"]]
        return facts

    def _show(self, smooth: bool = True) -> None:
        """Draw, and send what is drawn to all windows."""
        self._draw(smooth)
        self._view.update()

    def _show_front(self) -> None:
        """Send the picture of the front."""
        self._plot.update(frontier.figure(self.chosen.record, self.chosen.row, self.chosen.knee))

    # Painting and pulling

    @property
    def mirror(self) -> Mirror | None:
        """The plane in which strokes are mirrored, as the scenario has it."""
        if self.choices.symmetry is None:
            return None
        axis = "xyz".index(self.choices.symmetry)
        low, high = self.painting.vertices.min(axis=0), self.painting.vertices.max(axis=0)
        return Mirror.of_box(axis, float((low[axis] + high[axis]) / 2.0), low, high)

    @property
    def brush(self) -> Brush:
        """The brush that the page describes.

        Raises:
            UserError: if it describes none.
        """
        page, diagonal = self.page, self.painting.diagonal
        try:
            lengths = 0.01 * float(page.radius) * diagonal, 0.01 * float(page.strength) * diagonal
            return Brush(str(page.action), *lengths, 0.01 * float(page.edge), str(page.direction)).checked()
        except (TypeError, ValueError) as error:
            raise error if isinstance(error, UserError) else UserError("the brush needs numbers") from None

    def _canvas(self) -> Canvas:
        """What a pointer works on now."""
        return Canvas(self.painting, self.chosen, self.page.mode == "pull", self.brush, self.mirror)

    def press(self, window: str, brush: dict[str, Any], camera: Any, x: float, y: float, aspect: float) -> bool:
        """A pointer goes down; return whether it paints or pulls, and does not turn the view.

        Args:
            brush: as the window has it, from which news may still be on the way.
        """
        self.page.problem = ""
        self.page.update({name: brush[name] for name in layout.BRUSH if name in brush})
        taken = self.gestures.press(window, camera, x, y, aspect)
        if taken:
            self._show(smooth=False)
        return taken

    def drag(self, window: str, places: list[list[float]]) -> None:
        """The pointer that paints or pulls has moved along these places."""
        if self.gestures.drag(window, places):
            self._show(smooth=False)

    def release(self, window: str) -> None:
        """The pointer that paints or pulls goes up."""
        if self.gestures.release(window):
            self._show()

    def _gesture_ended(self, painted: bool) -> None:
        """A stroke or a pull has come to its end."""
        if painted:
            self._field_changed()
        else:
            self._changes += 1

    def _field_changed(self) -> None:
        """What is painted has changed: keep it, and search anew."""
        self.begin_anew()
        self._changes += 1
        self.page.start = ""
        self._search()

    def key(self, what: str) -> None:
        """A key, or a button that does the same."""
        if what in ("undo", "redo"):
            if getattr(self.painting, what)():
                self._field_changed()
                self._show()
        elif what in layout.HINTS:
            self.page.mode, self.page.hint = what, layout.HINTS[what]
            self._show()
        elif what == "view":
            self._view.push_camera()
        else:
            self.chosen.go(what)
            self._chosen_changed()

    def click(self, curve: int, point: int) -> None:
        """A click on the front."""
        if curve == 0:
            self.chosen.choose(int(point))
            self._chosen_changed()

    def _chosen_changed(self) -> None:
        """Another setup is shown."""
        self._changes += 1
        self._show()
        self._show_front()
        self.page.announcement = ", ".join(f"{name} {value}" for name, value in self.page.facts[:3])

    def let_go(self) -> None:
        """Put all control points back."""
        self.chosen.let_go()
        self._changes += 1
        self._show()

    def _share_changed(self, share: Any, **_: Any) -> None:
        """The slider for how far the shape goes has moved."""
        value = float(share) / 100.0
        if value != self.chosen.pulls.share:
            self.chosen.go_far(value)
            self.page.mode, self.page.hint = "pull", layout.HINTS["pull"]
            self._changes += 1
            self._show()

    def clear(self) -> None:
        """Take away all that is painted; it can be undone."""
        self._replace(np.zeros_like(self.painting.field), np.zeros_like(self.painting.held))

    def _start_changed(self, start: str, target: str, **_: Any) -> None:
        """A point array or a target shape was chosen to begin with."""
        self._answering(self._start_from)(start, target)

    def _start_from(self, start: str, target: str) -> None:
        """Take a point array of the template, or the way to a target shape, as what is painted."""
        if start and self.template is not None:
            self._replace(displacements(self.template.arrays[start], self.painting))
        elif target:
            self.page.target = ""
            pairing = paired(self.painting.vertices, self.painting.normals, target, None, "boundary", None)[0]
            self._replace(np.where(pairing.rejected[:, None], 0.0, pairing.displacement))

    def _replace(self, field: np.ndarray, held: np.ndarray | None = None) -> None:
        """Put a field, and perhaps held marks, in the place of what is painted."""
        if self.painting.replace(field, held):
            self._field_changed()
            self._show()

    # The search

    def _choices_changed(self, **_: Any) -> None:
        """What is searched has changed on the page."""
        self._answering(self._take_choices)()

    def _take_choices(self) -> None:
        """Search with the choices of the page, if they differ from those before.

        Raises:
            UserError: if they are none.
        """
        page, before = self.page, self.choices
        text = str(page.kernel_radius or "").strip()
        try:
            radius, centers = float(text) if text else None, int(page.centers)
        except (TypeError, ValueError):
            raise UserError(f"radius {text!r} and {page.centers!r} control points: give numbers") from None
        fields = {"kernel": page.kernel, "manipulation": page.manipulation, "symmetry": page.symmetry or None}
        radius = radius if page.kernel == before.kernel else None
        self.choices = dataclasses.replace(before, radius=radius, centers=centers, **fields)
        page.update(layout.of_choices(self.choices))
        if self.choices != before:
            page.problem = ""
            self._changes += 1
            self._search()

    def _search(self) -> None:
        """Search what is painted now."""
        given, self._given = self._given, None
        self.follower.search(self.painting, self.choices, given)

    def _found(self, front: Front) -> None:
        """A new front of what is painted now."""
        size = float(np.linalg.norm(np.where(self.painting.held[:, None], 0.0, self.painting.field)))
        self.page.kernel_length = layout.kernel_length(front.record)
        (at, moved), self._shown = self._shown, (None, None)
        self.chosen.take(front.record, size, at)
        if moved is not None:
            self.chosen.pulls = self.chosen.pulls._replace(moved=moved)
        self._changes += 1
        self._show(smooth=self.page.mode == "pull")
        self._show_front()

    def stop(self) -> None:
        """Stop the search; what it has found stays."""
        self.follower.stop()

    # What is kept, and what comes out

    def now(self) -> State:
        """All that can be kept, as it is now."""
        record, painting = self.chosen.record, self.painting
        return dataclasses.replace(
            self.state,
            field=painting.field.copy(),
            held=painting.held.copy(),
            choices=self.choices,
            centers=np.empty((0, 0, 3)) if record is None else record.centers,
            chosen=self.chosen.row,
            share=self.chosen.pulls.share,
            moved=self.chosen.pulls.moved,
            brush={name: getattr(self.page, name) for name in layout.BRUSH},
        )

    async def keep_often(self) -> None:
        """Keep the state on disk every few seconds, where it has changed."""
        spent = 0.0
        while True:
            await asyncio.sleep(max(KEPT_EVERY, SPARING * spent))
            begin = time.monotonic()
            await self.keep_now()
            spent = time.monotonic() - begin

    async def keep_now(self) -> None:
        """Keep the state on disk, if it has changed."""
        if self._kept == self._changes or self.offered is not None:
            return
        before, self._kept = self._kept, self._changes
        try:
            await asyncio.to_thread(keeping.keep, self.directory, self.now())
        except UserError as error:
            self._kept = before
            self.page.problem = str(error)
            self.page.flush()

    def offer(self, state: State, when: str) -> None:
        """Offer to go on with a state that was kept before."""
        self.offered = state
        self.page.offer = f"A painting of this surface was kept on {when}."

    def go_on(self) -> None:
        """Go on with what was offered."""
        state, self.offered, self.page.offer = self.offered, None, ""
        if state is not None:
            self._begin(state)
            self.page.update(layout.of_state(state))
            self.resume()
            self._show()

    def begin_anew(self) -> None:
        """Keep what was offered under another name, so that it is not written over."""
        if self.offered is not None:
            aside = keeping.put_aside(self.directory)
            self.offered, self.page.offer = None, ""
            self.page.announcement = f"the kept painting is now {aside}"

    def resume(self) -> None:
        """Search what a state has painted, with the setups that it has found."""
        if not self.painting.empty:
            self._search()

    def save(self) -> None:
        """Write the run directory."""
        self._write(lambda saved: f"saved: {saved.run}")

    def export(self) -> None:
        """Export the chosen setup."""
        row = self.chosen.row or 0
        self._write(lambda saved: f"exported: {saving.export(saved, row)}")

    def apply(self) -> None:
        """Deform the file that the painting began with, as it is shown."""
        shape, row, source = self.chosen.shape, self.chosen.row, Path(self.state.source)
        if shape is not None and row is not None:
            weights = shape.weights(self.chosen.pulls)
            self._write(lambda saved: f"written: {saving.apply(saved, row, weights, source)}")

    def _write(self, act: Callable[[saving.Saved], str]) -> None:
        """Save, and do something with the saved run."""
        self.writer.write(self.now(), self._changes, act)

    # Running

    async def run(self, announce: Callable[[str], None]) -> None:
        """Serve the page until the task is cancelled.

        Args:
            announce: takes the address once the server listens.
        """
        logging.getLogger("wslink").setLevel(logging.WARNING)
        host, port = self._address

        def bind(wslink: Any) -> None:
            """Let the guard see every request."""
            wslink.app.middlewares.append(self.guard.middleware())

        def ready(**_: Any) -> None:
            """Say where the page is, and begin."""
            self.guard.port = self.server.port
            announce(f"http://{host}:{self.server.port}/?token={self.guard.token}")
            self.follower.start(self.painting, self.choices)
            self.resume()

        self.server.controller.on_server_bind.add(bind)
        self.server.controller.on_server_ready.add(ready)
        keeper = asyncio.create_task(self.keep_often())
        try:
            options = {"exec_mode": "coroutine", "open_browser": False, "show_connection_info": False, "thread": True}
            serving: Any = self.server.start(port=port, host=host, timeout=0, **options)
            await serving
        finally:
            keeper.cancel()
            self.gestures.end()
            await self.keep_now()
            self.follower.close()
