"""Free-form deformation: columns are the basis functions of a lattice of control points in a box, 0 outside it.

Indirect manipulation moves the control points, U = B(X). Direct manipulation moves k points S on the surface by the
least displacements of the control points that do so, U = B(X) B(S)^+ (Hsu, Hughes & Kaufman, "Direct manipulation of
free-form deformations", SIGGRAPH 1992; Menzel, Olhofer & Sendhoff, "Direct manipulation of free form deformation in
evolutionary design optimisation", PPSN 2006): its columns reach less than those of B(X), so that P and V depend on the
manipulation.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations.lattice import Lattice
from rbfevo.scoring.representations.representation import Reduced, Representation, Space, with_own_columns

if TYPE_CHECKING:
    from torch import Tensor

    from rbfevo.scenarios.scenario import Scenario

EPS = float(np.finfo(float).eps)


class Half(NamedTuple):
    """Of a box that is symmetric about a plane, the control points on one side of it, the middle ones included.

    Attributes:
        axis: across the plane; side: +1 or -1, on which the control points are.
        sign: +1 for components of a displacement along the plane; -1 across it, where the middle ones have no column.
    """

    axis: int
    side: int = 1
    sign: int = 1


class FFD(Representation):
    """Setups are genotypes [D] of `Lattice`; with picks, followed by the numbers [m] of the control points that move.

    Args:
        lattice: control points and basis functions.
        still: layers of control points at each face of the box that do not move: displacements are 0 there with all
            derivatives up to the order still - 1.
        half: of a symmetric design, or None.
        picked: how many control points of the lattice move, or None for all but the still ones.
        surface: S [k, d] of direct manipulation, or None.
    """

    name = "ffd"
    block = 4096
    manipulations = ("indirect", "direct")

    def __init__(
        self,
        lattice: Lattice,
        still: int = 0,
        half: Half | None = None,
        picked: int | None = None,
        surface: Array | None = None,
    ) -> None:
        self.lattice, self.still, self.half, self.picked, self.surface = lattice, still, half, picked, surface
        self.shape = (lattice.size + (picked or 0),)
        self.layers = [self._layers(axis) for axis in range(lattice.dimension)]
        self.asked = 0  # columns that a user wants; 0 for all
        self.whole: Array | None = None  # the box around the design that control points are picked in

    def _layers(self, axis: int) -> range:
        """The layers of control points that move, of a mirrored axis those on one side."""
        n = self.lattice.counts[axis]
        first, end = self.still, n - self.still
        if self.half is not None and axis == self.half.axis:
            middle = 0 if self.half.sign > 0 else n % 2
            if self.half.side > 0:
                first = max(first, n // 2 + middle)
            else:
                end = min(end, (n + 1) // 2 - middle)
        return range(first, max(first, end))

    # --- columns ------------------------------------------------------------------------------------------------------

    def columns(self, setups: Any) -> int:
        """The control points that move."""
        return self.active if self.picked is None else self.picked

    def parameters(self, setups: Any) -> int:
        """The control points that move, or the points on the surface."""
        return self.columns(setups) if self.surface is None else len(self.surface)

    @property
    def active(self) -> int:
        """How many control points can move, of a symmetric box on one side of its plane."""
        return math.prod(len(layers) for layers in self.layers)

    def phi(self, points: Any, setups: Any) -> Any:
        """B [*pop, q, m] at points [q, d]."""
        xp = namespace(points)
        u, inside = self.lattice.local(points, setups)
        found = xp.where(inside, 1.0, 0.0 * u[..., 0])[..., None]
        for axis in range(self.lattice.dimension):
            values = self._of_layers(self.lattice.values(u[..., axis], setups, axis), axis)
            product = found[..., :, None] * values[..., None, :]
            found = product.reshape(*values.shape[:-1], product.shape[-2] * product.shape[-1])
        return found if self.picked is None else self._of_picks(found, setups)

    def _of_layers(self, values: Any, axis: int) -> Any:
        """Basis functions [..., n] of an axis for the layers that move, of a mirrored one with their images."""
        layers = self.layers[axis]
        found = values[..., layers.start : layers.stop]
        if self.half is None or axis != self.half.axis:
            return found
        n, images = self.lattice.counts[axis], namespace(values).flip(values, (-1,))[..., layers.start : layers.stop]
        middle = [1.0 if 2 * layer == n - 1 else 0.0 for layer in layers]  # its own image, counted once
        own = values.new_tensor(middle) if not isinstance(values, np.ndarray) else np.array(middle)
        return found + self.half.sign * (1.0 - own) * images

    def _of_picks(self, columns: Any, setups: Any) -> Any:
        """Those [*pop, q, m] of columns [*pop, q, active] that genotypes pick."""
        picks = setups[..., None, self.lattice.size :].round()
        if isinstance(columns, np.ndarray):
            index = np.clip(np.nan_to_num(picks), 0, self.active - 1).astype(np.int64)
            return np.take_along_axis(columns, np.broadcast_to(index, (*columns.shape[:-1], self.picked or 0)), axis=-1)
        index = picks.detach().nan_to_num().clamp(0, self.active - 1).long()
        return columns.gather(-1, index.expand(*columns.shape[:-1], -1))

    def pull(self, points: Tensor, setups: Tensor, gradient: Tensor) -> Tensor | None:
        """By the derivatives of the basis functions in the box; None where knots are searched."""
        import torch

        if self.lattice.knots or self.picked is not None:
            return None
        d = self.lattice.dimension
        u, inside = self.lattice.local(points, setups)
        rest = gradient.mT.unflatten(-1, [len(layers) for layers in self.layers])
        whole, slopes = torch.where(inside[(..., *[None] * d)], rest, 0.0), {}
        for axis in reversed(range(d)):
            values = self._of_layers(self.lattice.values(u[..., axis], setups, axis), axis)
            steep = self._of_layers(self.lattice.slopes(u[..., axis], setups, axis), axis)
            slopes = {own: _contracted(part, values) for own, part in slopes.items()}
            slopes[axis], whole = _contracted(whole, steep), _contracted(whole, values)
        du = torch.stack([slopes[axis] for axis in range(d)], dim=-1)
        return self.lattice.pull(points, setups, du)

    def places(self, setups: Any) -> Any:
        """Where the control points [*pop, m, d] sit that move."""
        every = self.lattice.places(setups[..., : self.lattice.size])
        kept = every[(..., *(slice(layers.start, layers.stop) for layers in self.layers), slice(None))]
        kept = kept.reshape(*setups.shape[:-1], self.active, self.lattice.dimension)
        if self.picked is None:
            return kept
        return _swapped(self._of_picks(_swapped(kept), setups))

    def indices(self, setup: Array) -> Array:
        """The places [m, d] in the lattice of the control points of one setup that move."""
        grid = np.stack(np.meshgrid(*self.layers, indexing="ij"), axis=-1).reshape(-1, self.lattice.dimension)
        return grid if self.picked is None else _swapped(self._of_picks(_swapped(grid), setup))

    def handles(self, setups: Any) -> Any:
        """The control points that move, or the points on the surface."""
        if self.surface is None:
            return self.places(setups)
        shape = (*setups.shape[:-1], *self.surface.shape)
        if isinstance(setups, np.ndarray):
            return np.broadcast_to(self.surface, shape).copy()
        return setups.new_tensor(self.surface).expand(shape)

    # --- direct manipulation ------------------------------------------------------------------------------------------

    def weights(self, setups: Any) -> Any | None:
        """None, the identity, or W = B(S)^+."""
        return None if self.surface is None else self.pseudoinverse(setups)

    def pseudoinverse(self, setups: Any) -> Any:
        """B(S)^+ [*pop, m, k]: singular values up to max(m, k) eps times the largest count as 0."""
        if isinstance(setups, np.ndarray):
            B = self.phi(self.surface, setups)
            return np.linalg.pinv(B, rcond=max(B.shape[-2:]) * EPS)
        import torch

        B = self.phi(setups.new_tensor(self.surface), setups)
        rtol = max(B.shape[-2:]) * EPS
        each = [
            torch.linalg.pinv(one, rtol=rtol) for one in B.reshape(-1, *B.shape[-2:])
        ]  # a batch may round otherwise
        return torch.stack(each).reshape(B.mT.shape) if each else B.mT

    @property
    def narrows(self) -> bool:
        """With points on the surface, whose pseudoinverse may have any rank."""
        return self.surface is not None

    def reduce(self, setups: Tensor, factor: Tensor, manipulation: str) -> Reduced:
        """B(S)^+, which always exists."""
        import torch

        from rbfevo.scoring.matrices import product

        if self.surface is None:
            return super().reduce(setups, factor, manipulation)
        W = self.pseudoinverse(setups)
        return Reduced(product(W.mT, factor), W, torch.zeros(len(setups), dtype=torch.bool, device=factor.device))

    def pull_weights(self, setups: Tensor, gradient: Tensor) -> Tensor:
        """By autograd: B(S) has as few rows as there are points on the surface."""
        import torch

        with torch.enable_grad():
            leaf = setups.detach().requires_grad_()
            return torch.autograd.grad(self.pseudoinverse(leaf), leaf, gradient)[0]

    def matrix(self, phi: Tensor, setup: Tensor, manipulation: str) -> Tensor:
        """B(X), or B(X) B(S)^+."""
        return phi if self.surface is None else phi @ self.pseudoinverse(setup)

    # --- runs ---------------------------------------------------------------------------------------------------------

    def spec(self) -> dict[str, Any]:
        """The lattice, what moves of it, and the points on the surface."""
        lattice, half = self.lattice, self.half
        return {
            "target": f"{FFD.__module__}.{FFD.__qualname__}",
            "lattice": list(lattice.counts),
            "degree": list(lattice.degrees),
            "turn": None if lattice.turn is None else "xyz"[lattice.turn],
            "knots": lattice.knots,
            "still": self.still,
            "half": None if half is None else {"axis": "xyz"[half.axis], "side": half.side},
            "picked": self.picked,
            "surface": None if self.surface is None else self.surface.tolist(),
        }

    @classmethod
    def of_spec(cls, **numbers: Any) -> FFD:
        """What `spec` describes."""
        turn, half, surface = numbers["turn"], numbers["half"], numbers["surface"]
        lattice = Lattice(
            tuple(numbers["lattice"]),
            tuple(numbers["degree"]),
            None if turn is None else "xyz".index(turn),
            bool(numbers["knots"]),
        )
        return cls(
            lattice,
            int(numbers["still"]),
            None if half is None else Half("xyz".index(half["axis"]), int(half["side"])),
            numbers["picked"],
            None if surface is None else np.array(surface, dtype=np.float64),
        )

    def _like(self, **changes: Any) -> FFD:
        """The same with other arguments."""
        parts = {name: getattr(self, name) for name in ("lattice", "still", "half", "picked", "surface")}
        made = FFD(**{**parts, **changes})
        made.asked, made.whole = self.asked, self.whole
        return made

    def symmetric(self, mirror: Mirror) -> tuple[FFD, FFD]:
        """B_i + B_i' along the plane, and B_i - B_i' across it, of control points i and their images i'."""
        half = self.half or Half(mirror.axis)
        across = self.surface
        if across is not None:
            across = across[~mirror.on_plane(across)]
        return self._like(half=half._replace(sign=1)), self._like(half=half._replace(sign=-1), surface=across)

    def for_run(self, scenario: Scenario, manipulation: str) -> FFD:
        """With the half of a symmetric design, the picks, and the points on the surface that `centers=` asks for.

        Raises:
            UserError: if the lattice does not fit the scenario, or has fewer control points than are asked for.
        """
        from rbfevo.scoring.representations import boxes

        boxes.refuse_unfit(self.lattice, scenario)
        made = copy.copy(self)
        if scenario.mirror is not None:
            made = made._like(half=Half(scenario.mirror.axis, int(scenario.side)))
        asked = made.asked or made.active
        shown = " x ".join(map(str, self.lattice.counts))
        side = "" if scenario.mirror is None else " on one side of the symmetry plane"
        if not made.active or asked > made.active:
            raise UserError(
                f"centers={asked}: the lattice {shown} has {made.active} control points that move{side}; leave "
                "centers= out, or give a finer lattice"
            )
        if manipulation == "direct":
            return made._like(surface=boxes.spread(scenario, asked))
        if asked < made.active:
            if scenario.mirror is not None and self.lattice.counts[scenario.mirror.axis] % 2:
                raise UserError(
                    f"centers={asked}: control points that are picked cannot lie on the symmetry plane; give the "
                    f"lattice {shown} an even number along {'xyz'[scenario.mirror.axis]}"
                )
            made = made._like(picked=asked)
        made.whole = boxes.around(self.lattice, scenario)
        return made

    def off_plane(self) -> Tensor:
        """Which of the control points [active] are not in the middle layer, whose images they are themselves."""
        import torch

        grid = np.stack(np.meshgrid(*self.layers, indexing="ij"), axis=-1).reshape(-1, self.lattice.dimension)
        if self.half is None or self.picked is not None:  # picks have no middle layer
            return torch.ones(self.picked or len(grid), dtype=torch.bool)
        return torch.from_numpy(2 * grid[:, self.half.axis] != self.lattice.counts[self.half.axis] - 1)

    def candidates(self) -> Tensor | None:
        """The control points [active, d] of the box around the design, where some of them are picked."""
        import torch

        if self.picked is None or self.whole is None:
            return None
        return self._like(picked=None).places(torch.from_numpy(self.whole))

    def refuse_places(self, method: str) -> NoReturn:
        """Raise UserError: control points are picked by number, under indirect manipulation."""
        if self.surface is not None:
            raise UserError(
                f"method={method} picks control points, which manipulation=direct does not move; set "
                "manipulation=indirect"
            )
        raise UserError(
            f"method={method} picks some of the {self.active} control points that move: give their number as centers=, "
            f"below {self.active}"
        )

    def atoms(self, points: Tensor) -> Callable[[Tensor], Tensor] | None:
        """The columns of control points of the box around the design, of a symmetric one those along its plane."""
        import torch

        every = self.candidates()
        if every is None or self.whole is None:
            return None
        box = torch.from_numpy(self.whole).to(points)
        u, inside = self.lattice.local(points, box)
        values = [
            self._of_layers(self.lattice.values(u[..., axis], box, axis), axis)
            for axis in range(self.lattice.dimension)
        ]
        sizes = [len(layers) for layers in self.layers]

        def columns(candidates: Tensor) -> Tensor:
            """Columns [n, q] of the control points nearest to candidates [q, d]; 0 outside the box."""
            index = np.unravel_index(_nearest(candidates, every).numpy(), sizes)
            found = inside.to(points)[:, None].expand(-1, len(candidates)).clone()
            for one, along in zip(values, index, strict=True):
                found *= one[:, torch.from_numpy(along)]
            return found

        return columns

    def assemble(self, centers: Tensor) -> Tensor | None:
        """The box around the design, and the numbers of the control points that are nearest to the centers."""
        import torch

        every = self.candidates()
        if every is None or self.whole is None or centers.shape[-2] != self.picked:
            return None
        box = torch.from_numpy(self.whole).to(centers)
        return torch.cat((box.expand(*centers.shape[:-2], -1), _nearest(centers, every).to(centers)), dim=-1)

    def given(self, files: Sequence[str], scenario: Scenario) -> Tensor:
        """Boxes from exports and files of other programs."""
        import torch

        from rbfevo.scoring.representations.given_boxes import read_box

        return torch.from_numpy(np.stack([read_box(file, self, scenario) for file in files]))

    def jumps(self, points: Any, setups: Any) -> Any | None:
        """Which points lie in the box, where control points at its faces move."""
        return None if self.still else self.lattice.local(points, setups)[1]

    def refuse_search(self, method: str) -> None:
        """Raise UserError where control points are picked: they have numbers, not places that could be searched."""
        if self.picked is not None:
            shown = " x ".join(map(str, self.lattice.counts))
            raise UserError(
                f"centers={self.picked}: {self.active} control points of the lattice {shown} can move, and "
                f"method={method} moves all of them; leave centers= out, or let method=ols pick {self.picked}"
            )

    def notes(self) -> dict[str, str]:
        """The lattice, what moves of it, and that direct manipulation reaches less."""
        lattice = self.lattice
        degrees = sorted(set(lattice.degrees))
        kind = f"B-splines of degree {', '.join(map(str, degrees))}" if sum(lattice.inner) else "Bernstein polynomials"
        lines = {"lattice": f"lattice of {' x '.join(map(str, lattice.counts))} control points, {kind}"}
        if self.surface is not None:
            lines["direct manipulation"] = (
                f"direct manipulation: {len(self.surface)} points on the surface move the {self.active} control points "
                "and reach less than all of these, so that P and V depend on the manipulation"
            )
        return lines

    def doubts(self, scenario: Scenario) -> list[str]:
        """A line where a scenario keeps a region free of centers, which a box cannot."""
        if scenario.keep_out is None:
            return []
        return [
            "scenario.keep_out: a box of representation=ffd covers what it holds, also the region that is kept free of "
            "centers; held vertices do not move all the same"
        ]

    def space(self, scenario: Scenario, centers: int) -> Space:
        """Boxes with their centre in the scenario's, from small ones to those that hold the whole design."""
        from rbfevo.scoring.representations import boxes

        if self.picked is not None and self.whole is not None:
            return boxes.picks(self.whole, self.picked, self.active)
        return boxes.search_space(self.lattice, scenario, self.surface)


def _contracted(rest: Tensor, values: Tensor) -> Tensor:
    """The sum over the last axis of `rest` [p, q, ..., n] with values [p, q, n]."""
    shape = (*values.shape[:2], *[1] * (rest.ndim - 3), values.shape[2])
    return (rest * values.reshape(shape)).sum(-1)


def _nearest(points: Tensor, every: Tensor) -> Tensor:
    """For each of points [..., d] the number of the nearest of `every` [c, d]."""
    import torch

    return torch.cdist(points, every.to(points), compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)


def _swapped(array: Any) -> Any:
    """The last two dimensions of an array exchanged."""
    return array.swapaxes(-1, -2)


@with_own_columns
def ffd(
    scenario: Scenario,
    kernel: Kernel,
    centers: int,
    lattice: Any = None,
    degree: Any = None,
    active: str = "all",
    continuity: int = 0,
    turn: str | None = None,
    knots: bool = False,
) -> FFD:
    """A lattice for a scenario.

    Args:
        scenario, kernel, centers: what every representation is made of; the kernel plays no part. As many `centers` as
            control points move, or 0; fewer are picked, or are points on the surface.
        lattice: control points along each axis, at least 2; None for 4.
        degree: of B-splines, a number or one for each axis; None for Bernstein polynomials, the highest there is.
        active: `all` control points move, or only `inner` ones: not those at the faces of the box.
        continuity: with `inner`, the order up to which derivatives of displacements are 0 at the faces.
        turn: `up` or an axis that boxes may be turned about, or None.
        knots: whether inner knots of B-splines are searched.

    Raises:
        UserError: if a setting does not fit the others.
    """
    from rbfevo.scoring.representations import boxes

    found = FFD(*boxes.checked(scenario, lattice, degree, active, continuity, turn, knots))
    found.asked = centers
    return found
