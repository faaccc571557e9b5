"""The deformed shape of one setup: as far along the painted displacement as asked, and as control points are pulled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Points
from rbfevo.errors import UserError
from rbfevo.geometry.triangles import doubled_area_vectors
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup


class Look(NamedTuple):
    """A deformed shape: vertices [n, 3], how far the farthest of them moved, and how many triangles folded over."""

    vertices: Points
    farthest: float
    folded: int


class Pulls(NamedTuple):
    """How a designer moves a setup.

    Attributes:
        share: of the best approximation of the painted displacement, 1 for all of it.
        moved: [m, 3] how far control points were pulled beyond that, model units.
    """

    share: float
    moved: Points


class Shape:
    """A setup whose columns are kept, so that each new position of a control point is one product of matrices.

    Args:
        record: the run that it belongs to; chosen: the setup.
        size: the norm of the painted displacement, whose direction is the gradient of the record.
    """

    def __init__(self, record: Record, chosen: Setup, size: float) -> None:
        self.record, self.chosen = record, chosen
        self._best = chosen.fit(record) * size
        points = record.vertices
        self._columns = [
            (components, chosen.blended(points, across)) for components, across, _ in chosen.parities(points.shape[1])
        ]
        self._before = doubled_area_vectors(points, record.faces)

    def weights(self, pulls: Pulls) -> Array:
        """Weights [m, 3] of the columns.

        With direct manipulation, and of kernels that are 0 at their own center, a pull displaces one control point and
        no other. With indirect manipulation it changes the weight of one column, such that the point itself moves by
        what was pulled.

        Raises:
            UserError: if the control points cannot be moved one by one, or one is pulled out of the plane it lies in.
        """
        chosen, weights = self.chosen, pulls.share * self._best
        if not pulls.moved.any():
            return weights
        own = 0.0 if chosen.kernel is None else float(np.asarray(chosen.kernel.phi(np.zeros(1)))[0])
        if chosen.manipulation == "indirect" and own != 0.0:
            chosen.refuse_across(pulls.moved, "displacement")
            return weights + pulls.moved / own / chosen.times[:, None]
        return weights + chosen.weights(pulls.moved)

    def look(self, pulls: Pulls) -> Look:
        """The shape under these pulls.

        Raises:
            UserError: as `weights`.
        """
        weights, moved = self.weights(pulls), np.zeros_like(self.record.vertices)
        for components, columns in self._columns:
            moved[:, components] = columns @ weights[:, components]
        vertices = self.record.vertices + moved
        folded = (self._before * doubled_area_vectors(vertices, self.record.faces)).sum(axis=1) < 0.0
        return Look(vertices, float(np.linalg.norm(moved, axis=1).max(initial=0.0)), int(folded.sum()))

    def points(self, pulls: Pulls) -> tuple[Points, Points]:
        """The control points [q, 3] before and after, images last."""
        chosen, weights = self.chosen, self.weights(pulls)
        rows = chosen.handles_moved(weights)
        rows = chosen.moved(rows)
        places = chosen.centers_and_images().points
        return places, places + chosen.with_images(rows)

    def allowed(self, center: int, pull: Array) -> Array:
        """A pull [3] of a control point without what would take it across the symmetry plane that it lies on."""
        mirror = self.chosen.mirror
        if mirror is None or not self.chosen.on_plane[center]:
            return pull
        kept = pull.copy()
        kept[mirror.axis] = 0.0
        return kept


def refuse_others(record: Record) -> None:
    """Raise UserError for a run whose setups cannot be painted for and pulled here."""
    name = record.summary.get("representation", {}).get("name", "rbf")
    why = None
    if record.genotype is not None or name != "rbf":
        why = f"its setups are those of representation={name}, and control points of RBFs are pulled here"
    elif record.vertices.shape[1] != 3 or record.summary.get("planar") is not None:
        why = "it is a design of two dimensions, and surfaces in space are painted here"
    elif not len(record.faces):
        why = "it has no triangles"
    elif record.gradients is not None:
        why = "it has several objectives; take one of them"
    if why is not None:
        raise UserError(f"this run cannot be opened: {why}")
