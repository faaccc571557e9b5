"""One recorded setup as columns of U, in NumPy: how its centers displace any point of the same space.

In a run with a symmetry plane every center c has a mirror image c', and the displacement of c' is the mirror image of
that of c: a column is phi(|c - x|) + phi(|c' - x|) for the components of a displacement along the plane and
phi(|c - x|) - phi(|c' - x|) for the component across it. A center on the plane is its own image; it cannot leave it.

In a planar run the centers lie in the mid-plane, and displacements have no component along its axis.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.holding import Hold
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.planar import LAYER, Plane
from rbfevo.recorded.parts import hold_in, mirror_in, plane_in, representation_in
from rbfevo.recorded.record import Record
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import RBF, Representation

BLOCK = 65_536  # rows at a time, or fewer where there are many centers
CELLS = 2**22  # numbers in a block of columns: 32 MB
EPS = float(np.finfo(float).eps)


class Centers(NamedTuple):
    """The centers that a deformation really has, q of them: those of the setup and, with a mirror, their images.

    Attributes:
        points: [q, d], model units; column: [q] which column of U each belongs to; mirrored: [q] True for an image.
    """

    points: Array
    column: Array
    mirrored: Array


@dataclasses.dataclass(frozen=True)
class Setup:
    """One recorded setup of m centers in d dimensions (NumPy, float64, model units).

    Attributes:
        centers: [m, d]; a center on the symmetry plane is exactly on it.
        representation: what makes the columns of U; kernel: phi, None where it has none.
        manipulation: the run's, `indirect` or `direct`.
        mirror: the symmetry plane, or None.
        on_plane: [m] True for a center on the symmetry plane; all False without one.
        hold: the blend that multiplies U, or None where nothing is held.
        row: the row of setups.npz; regularity, improvement_potential: its scores.
        planar: the mid-plane of a planar run, or None; tolerance: within it of a side of the slab a point is on it.
    """

    centers: Array
    representation: Representation
    manipulation: str
    mirror: Mirror | None
    on_plane: Array
    row: int
    regularity: float
    improvement_potential: float
    genotype: Array | None = None
    hold: Hold | None = None
    planar: Plane | None = None
    tolerance: float = 0.0

    @property
    def kernel(self) -> Kernel | None:
        """phi of a representation by RBFs."""
        return self.representation.kernel if isinstance(self.representation, RBF) else None

    @property
    def plain(self) -> bool:
        """Whether each column is a kernel around one center."""
        return isinstance(self.representation, RBF) and self.representation.plain

    @property
    def name(self) -> str:
        """The name of the kernel, or of another representation."""
        return self.representation.name if self.kernel is None else self.kernel.name

    @property
    def support(self) -> float | None:
        """The support radius of a compact kernel."""
        return None if self.kernel is None else self.kernel.support

    @property
    def count(self) -> int:
        """m, the parameters for each component of a displacement."""
        return self.representation.columns(self.centers if self.genotype is None else self.genotype)

    @property
    def off_plane(self) -> Array:
        """Indices [m_off] of the centers off the symmetry plane; all of them without one."""
        return np.flatnonzero(~self.on_plane)

    @property
    def off_columns(self) -> Array:
        """Indices of the columns of Phi whose control points are off the symmetry plane; all of them without one."""
        if self.genotype is None or self.mirror is None:
            return self.off_plane
        return np.flatnonzero(~self.mirror.on_plane(self.weight_places))

    @property
    def weight_places(self) -> Array:
        """Where the control points [m, d] of the columns of Phi sit; NaN of a representation that has none."""
        if self.genotype is None:
            return self.centers
        places = self.representation.places(self.genotype)
        return np.full((self.count, self.centers.shape[1]), np.nan) if places is None else np.asarray(places)

    @property
    def times(self) -> Array:
        """[m] how often each center counts in the columns along the symmetry plane: one on it twice, of RBFs."""
        return 1 + self.on_plane * (self.kernel is not None)

    def _part(self, across: bool) -> Representation:
        """What makes the columns along the symmetry plane, or of all, or those across it."""
        pair = None if self.mirror is None else self.representation.symmetric(self.mirror)
        return self.representation if pair is None else pair[1] if across else pair[0]

    def columns(self, points: Array, across: bool = False) -> Array:
        """Phi [q, m] at points [q, d]: with a mirror the columns along its plane, or those across it."""
        if self.genotype is None and across and self.mirror is not None:
            found, off = np.zeros((len(points), self.count)), self.off_plane
            if len(off):  # those on the plane have no column
                found[:, off] = self._part(across).phi(points, self.centers[off])
            return found
        found = np.asarray(self._part(across).phi(points, self.centers if self.genotype is None else self.genotype))
        if self.genotype is None or not across or self.mirror is None:
            return found
        columns = np.zeros((len(points), self.count))  # those on the plane have none
        columns[:, self.off_columns] = found
        return columns

    def blended(self, points: Array, across: bool = False) -> Array:
        """The columns [q, m] at points [q, d] times the blend of what is held: U of indirect manipulation."""
        return self.blend(points) * self.columns(points, across)

    def psi(self, across: bool = False) -> Array:
        """Psi [m, m], the columns at the centers; across the plane [m_off, m_off], of the centers off it."""
        if not across or self.mirror is None:
            return self.columns(self.centers)
        return self.columns(self.centers[self.off_plane], across=True)[:, self.off_plane]

    def immovable(self, k: int) -> str:
        """Why the control points cannot be moved one by one by displacements with k components; empty if they can."""
        if self.genotype is not None:
            try:
                self.representation.weights(self.genotype)
            except UserError as error:
                return str(error)
            return ""
        if self.singular() or (self.crosses(k) and self.singular(across=True)):
            return "these centers cannot be moved one by one: their kernel matrix Psi is numerically singular"
        return ""

    def singular(self, across: bool = False) -> bool:
        """Whether Psi is numerically singular: condition number (1-norm) above 1/(m eps), as for the scores."""
        psi = self.psi(across)
        if psi.size == 0:
            return False
        try:
            condition = np.linalg.norm(psi, 1) * np.linalg.norm(np.linalg.inv(psi), 1)
        except np.linalg.LinAlgError:
            return True
        return not condition < 1.0 / (len(psi) * EPS)

    def crosses(self, k: int) -> bool:
        """Whether displacements with k components have one across a symmetry plane; heights (k = 1) have none."""
        return self.mirror is not None and k > 1

    def is_across(self, components: Array, k: int) -> bool:
        """Whether components of a displacement with k of them are those across the symmetry plane."""
        return self.mirror is not None and self.crosses(k) and self.mirror.axis in components

    def parities(self, k: int) -> Iterator[tuple[Array, bool, Array]]:
        """Split k components of a displacement by their columns: components, across or not, indices of the columns.

        That along the axis of a planar run is left out: it is 0.
        """
        everything = np.arange(self.count)
        axis = self.mirror.axis if self.mirror is not None and k > 1 else -1
        apart = {axis, -1 if self.planar is None else self.planar.axis}
        yield np.array([component for component in range(k) if component not in apart], dtype=int), False, everything
        if axis >= 0:
            yield np.array([axis]), True, self.off_columns

    def refuse_across(self, rows: Array, what: str) -> None:
        """Raise UserError where rows [m, k] would move a center out of a plane that it cannot leave."""
        if self.planar is not None and rows[:, self.planar.axis].any():
            wrong, axis = int(np.flatnonzero(rows[:, self.planar.axis])[0]), self.planar.name
            raise UserError(
                f"the run is planar (scenario.planar={axis}), and center {wrong} cannot leave the plane {axis} = "
                f"{self.planar.at:g}: its {what} along {axis} must be 0, not {rows[wrong, self.planar.axis]:g}"
            )
        if self.mirror is None or not self.crosses(rows.shape[1]):
            return
        still = self.on_plane
        if what == "weight":
            still = np.ones(self.count, dtype=bool)
            still[self.off_columns] = False
        wrong = np.flatnonzero(still & (rows[:, self.mirror.axis] != 0))
        if wrong.size:
            axis = "xyz"[self.mirror.axis]
            raise UserError(
                f"center {wrong[0]} lies on the symmetry plane {axis} = {self.mirror.at:g} and cannot leave it: its "
                f"{what} along {axis} must be 0, not {rows[wrong[0], self.mirror.axis]:g}"
            )

    def weights(self, displacements: Array) -> Array:
        """Weights [m, k] of the columns of Phi that move the handles by these displacements [h, k], model units.

        Raises:
            UserError: if Psi is numerically singular, or a center is to leave the symmetry plane that it lies on.
        """
        if self.genotype is not None and (reason := self.immovable(displacements.shape[1])):
            raise UserError(f"{reason}; give weights instead (--weights)")
        self.refuse_across(displacements, "displacement")
        weights = np.zeros((self.count, displacements.shape[1]))
        for components, across, columns in self.parities(displacements.shape[1]):
            if self.kernel is not None and self.singular(across):
                raise UserError(
                    "these centers cannot be moved one by one: their kernel matrix Psi is numerically singular (do two "
                    "of them coincide?); choose another pick, or give RBF weights (--weights)"
                )
            if columns.size:
                own = displacements[np.ix_(self.rows_of(across), components)]
                weights[np.ix_(columns, components)] = self.reduced(own, across)
        return weights

    def rows_of(self, across: bool) -> Array:
        """Indices of the handles that have a displacement along the symmetry plane, or across it."""
        return self.off_plane if across else np.arange(len(self.centers))

    def reduced(self, rows: Array, across: bool = False) -> Array:
        """W times rows [h, ...] of displacements of the handles: weights [r, ...] of the columns of Phi."""
        if self.kernel is not None:
            return np.linalg.solve(self.psi(across), rows)
        W = None if self.genotype is None else self._part(across).weights(self.genotype)
        return rows if W is None else W @ rows

    def through(self, rows: Array, across: bool = False) -> Array:
        """W^T times rows [r, ...] of the columns of Phi: rows [m, ...] of those of U under direct manipulation."""
        if self.kernel is not None:
            return np.linalg.solve(self.psi(across).T, rows)
        W = None if self.genotype is None else self._part(across).weights(self.genotype)
        return rows if W is None else W.T @ rows

    def narrowed(self, columns: Array, across: bool = False) -> Array:
        """Columns U [q, m] of columns [q, r] of Phi where they reach less, as points on the surface do; else these."""
        W = self._narrow(across)
        return columns if W is None else columns @ W

    def widened(self, rows: Array, across: bool = False) -> Array:
        """Weights [r, ...] of rows [m, ...] of parameters of the `narrowed` columns."""
        W = self._narrow(across)
        return rows if W is None else W @ rows

    def _narrow(self, across: bool) -> Array | None:
        """W of a representation whose points on the surface reach less than its columns; None of others."""
        return self._part(across).weights(self.genotype) if self.representation.narrows else None

    def doubts(self, record: Record) -> list[str]:
        """A line where columns of U depend on each other, and one where they reach less than those of Phi."""
        if self.genotype is None or record.variability is None:
            return []
        rank = round(float(record.variability[self.row]) * len(record.vertices))
        m, lines = self.representation.parameters(self.genotype), []
        if rank < m:
            idle = int((self.columns(record.vertices) == 0.0).all(axis=0).sum())
            move = f"; {idle} control points move no vertex" if idle else ""
            lines.append(f"rank {rank} of {m} columns, so that R = 0: some combinations of them move no vertex{move}")
        inside = self.representation.jumps(record.vertices, self.genotype)
        if inside is not None and len(record.faces):
            torn = int((inside[record.faces].any(axis=1) != inside[record.faces].all(axis=1)).sum())
            if torn:
                lines.append(
                    f"the surface passes through the faces of the box, where displacements end abruptly, in {torn} "
                    "triangles: representation.active=inner keeps it whole"
                )
        if self.representation.narrows:
            lines.append(
                f"direct manipulation: {m} points on the surface move, and P and V are theirs, not those of the "
                f"{self.count} control points"
            )
        return lines

    @property
    def on_surface(self) -> bool:
        """Whether handles move as points of the design do, as centers and points on the surface, not control points."""
        return self.kernel is not None or (self.manipulation == "direct" and self.genotype is not None)

    def handles_moved(self, weights: Array) -> Array:
        """The parameters [h, k] that weights [m, k] are: displacements of the handles, but for the blend.

        0 of a representation whose control points cannot be moved one by one.
        """
        if self.kernel is None and self.immovable(weights.shape[1]):
            return np.zeros((len(self.centers), weights.shape[1]))
        found = self.free_displacement(self.centers, weights) if self.on_surface else weights.copy()
        if self.mirror is not None and self.crosses(found.shape[1]):
            found[self.on_plane, self.mirror.axis] = 0.0  # rounding apart it is
        return found

    def blend(self, points: Array) -> Array:
        """What the rows of U at points [q, d] are multiplied by: [q, 1], 0 at held points; ones where none is held."""
        return np.ones((len(points), 1)) if self.hold is None else self.hold(points)[:, None]

    def moved(self, centers: Array) -> Array:
        """How far the centers move [m, k] under parameters [m, k] of direct manipulation: less near held points."""
        return self.blend(self.centers) * centers if self.hold is not None and self.on_surface else centers

    def displacement(self, points: Array, weights: Array, block: int = BLOCK) -> Array:
        """Displacements [q, k] of points [q, d] under weights [m, k], a block of points at a time.

        In a planar run points that lie behind each other on the two sides of the slab move alike to the last bit.
        """
        return self.blend(points) * self.free_displacement(points, weights, block)

    def free_displacement(self, points: Array, weights: Array, block: int = BLOCK) -> Array:
        """Displacements [q, k] of points [q, d] as if nothing were held: at the centers what `weights` takes."""
        moved, block = np.zeros((len(points), weights.shape[1])), self.rows_at_once(block)
        for start in range(0, len(points), block):
            rows = slice(start, start + block)
            places = self.on_one_side(points[rows])
            for components, across, _ in self.parities(weights.shape[1]):
                phi, own = self.columns(places, across), weights[:, components]
                if self.planar is None:
                    moved[rows, components] = phi @ own
                else:  # a product of matrices may add up in another order in each row
                    moved[rows, components] = sum(phi[:, j, None] * own[j] for j in range(len(own)))
        return moved

    def on_one_side(self, points: Array) -> Array:
        """Points [q, 3], those on either side of a slab with the same coordinate along its axis."""
        if self.planar is None:
            return points
        axis, at, depth = self.planar.axis, self.planar.at, self.planar.depth
        places, away = points.copy(), np.abs(points[:, self.planar.axis] - at)
        places[:, axis] = at + np.where(np.abs(away - depth) <= self.tolerance, depth, away)
        return places

    def fit(self, record: Record, block: int = BLOCK) -> Array:
        """Weights [m, k] of the least-squares best approximation of the run's gradient, as it is, of unit norm.

        Rows count with the square root of their weight. One pass over blocks of vertices keeps the triangular factor of
        [Phi | g]; where columns depend on each other the weights are those of minimum norm.

        Raises:
            UserError: for a run of several objectives, each of which has a best approximation of its own.
        """
        if record.gradients is not None:
            raise UserError(f"this run has several objectives, {', '.join(record.objectives)}: take one of them")
        (n, k), block = record.gradient.shape, self.rows_at_once(block)
        weights = np.zeros((self.count, k))
        for components, across, columns in self.parities(k):
            width = len(self.rows_of(across)) if self.representation.narrows else len(columns)
            triangle = np.empty((0, width + len(components)))
            for start in range(0, n, block):
                rows = slice(start, start + block)
                phi = self.narrowed(self.blended(record.vertices[rows], across)[:, columns], across)
                here = np.hstack([phi, record.gradient[rows][:, components]]) * np.sqrt(record.weights[rows, None])
                triangle = np.asarray(np.linalg.qr(np.vstack([triangle, here]), mode="r"))
            if columns.size:
                left, right = triangle[:, :width], triangle[:, width:]
                found = np.linalg.lstsq(left, right, rcond=max(n, width) * EPS)[0]
                weights[np.ix_(columns, components)] = self.widened(found, across)
        return weights

    def best(self, record: Record, block: int = BLOCK) -> Array:
        """Weights [m, k] of the least-squares best approximation of the wanted displacement g, in model units.

        Without a recorded gradient norm the displacement is that of unit norm.
        """
        return self.fit(record, block) * (record.gradient_norm or 1.0)

    def rows_at_once(self, block: int = BLOCK) -> int:
        """How many rows of columns are made at a time."""
        return min(block, max(1024, CELLS // self.count))

    def centers_and_images(self) -> Centers:
        """All centers that the deformation really has; one on the symmetry plane stands there once."""
        m = len(self.centers)
        if self.mirror is None:
            return Centers(self.centers, np.arange(m), np.zeros(m, dtype=bool))
        off = self.off_plane
        return Centers(
            np.concatenate([self.centers, self.mirror.image(self.centers[off])]),
            np.concatenate([np.arange(m), off]),
            np.repeat([False, True], [m, len(off)]),
        )

    def with_images(self, rows: Array) -> Array:
        """Rows [m, k] of displacements of the centers, followed by those of the images [q, k]."""
        if self.mirror is None:
            return rows
        images = rows[self.off_plane].copy()
        if self.crosses(rows.shape[1]):
            images[:, self.mirror.axis] *= -1.0
        return np.concatenate([rows, images])


def setup(record: Record, row: int) -> Setup:
    """Setup `row` of a run.

    Raises:
        UserError: if summary.json names a kernel or a symmetry that is not known here.
    """
    representation = representation_in(record)
    mirror, centers = mirror_in(record), np.array(record.centers[row], dtype=np.float64)
    on_plane, planar = np.zeros(len(centers), dtype=bool), plane_in(record)
    if mirror is not None:
        on_plane, centers = mirror.on_plane(centers), mirror.snapped(centers)
    return Setup(
        centers=centers,
        representation=representation,
        manipulation=str(record.summary.get("manipulation", "indirect")),
        mirror=mirror,
        on_plane=on_plane,
        row=int(row),
        regularity=float(record.regularity[row]),
        improvement_potential=float(record.improvement_potential[row]),
        hold=hold_in(record, mirror, planar),
        genotype=None if record.genotype is None else np.array(record.genotype[row], dtype=np.float64),
        planar=planar,
        tolerance=LAYER * float(np.linalg.norm(np.ptp(record.vertices, axis=0))),
    )
