"""Bounded potential P_p: improvement potential for a displacement of bounded p-norm in place of a bounded mean square.

With weights w, u_i = w_i / sum w, the wanted displacement g and a_i = u_i g_i,

    G = max over q of a.Uq / |Uq|_p,    P_p = (G / |a|_p*)^2,    p* = p / (p - 1),

is in [0, 1] by Hoelder's inequality, maximized, the same for every manipulation, and P for p = 2. At the optimum
d = Phi w with |d|_p = 1 it changes with the setup by dG = sum_i (a_i - G h_i).(dPhi_i w), h_i = u_i |d_i|^(p-2) d_i
(envelope theorem). U includes the blend of held regions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.evolvability import cutoff
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.matrices import all_finite
from rbfevo.scoring.maxnorm import Block, best_displacement, power
from rbfevo.scoring.maxnorm import dual_norm as dual_norm_of
from rbfevo.scoring.pnorm import Best, Part, best, dual_norm
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.threads import coarse, run_in_slices

VALUE = 5e-7  # of G, by which its bound may lie above it: values of P_p, its square, then hold to 1e-6
ROWS = 2048  # of a step over the vertices: in cache
SAMPLE = 2000  # vertices on which a search begins without a start, if there are twice as many
ALIKE = 1e-10  # of the largest eigenvalue of a Gram matrix: from a smaller one on, columns get a QR decomposition


class Optima(NamedTuple):
    """What is best within setups [p, *setup].

    Attributes:
        values: [p] P_p, maximized; NaN where a setup is not finite, 0 where nothing in reach gains anything.
        weights: [p, r, k] w of the best displacement Phi w, of unit p-norm. Those of a symmetric setup have the
            component across the plane in its own column, 0 for centers on the plane.
        gradients: [p, *setup] of P_p in the setups, or None; 0 where there is none.
        passes: [p] passes over the vertices, each with an assembly of the curvature.
        near: [p, s + r k] the numbers of each setup and its weights, a start for similar setups: weights alone mean
            another displacement where columns nearly cancel.
    """

    values: Tensor
    weights: Tensor
    gradients: Tensor | None
    passes: Tensor
    near: Tensor


class _Columns(NamedTuple):
    """Components that share columns of a setup: their numbers, its centers or other setup [*setup], which those are."""

    components: list[int]
    representation: Representation
    setup: Tensor
    rows: Tensor | None  # [m] bool, centers that have a column; None for all


class BoundedPotential:
    """P_p of populations of setups of one design, on the host; the threads of torch share the setups.

    Args:
        vertices: [n, d] float64, model units; gradient: g [n, k], of any size; weights: [n] positive, or None for ones.
        representation: what makes columns of a setup, or the kernel of RBFs.
        p: at least 2.
        blend: [n] what rows of U are multiplied by, or None for ones.
        mirror: the plane of symmetry, or None.
        most: [n] positive, how far each vertex may move at most: lengths |d_i| then count in these; None if alike.

    Attributes:
        evaluations, passes: setups so far, and their passes over the vertices.

    Raises:
        UserError: if p is below 2 or not finite, or the representation has no symmetric setups.
    """

    def __init__(
        self,
        vertices: Tensor,
        gradient: Tensor,
        representation: Representation | Kernel,
        p: float,
        weights: Tensor | None = None,
        blend: Tensor | None = None,
        mirror: Mirror | None = None,
        most: Tensor | None = None,
    ) -> None:
        if not 2.0 <= p < float("inf"):
            raise UserError(f"criterion.norm={p:g}: give a number of at least 2")
        self.p, self.mirror = float(p), mirror
        self.vertices, self.gradient = vertices.cpu(), gradient.cpu()
        self.representation = RBF(representation) if isinstance(representation, Kernel) else representation
        self.blend = None if blend is None else blend.cpu()
        if most is not None:  # e_i = d_i / b_i: the columns over b, what a displacement gains times b
            share = (most / most.max()).cpu()
            self.gradient = share[:, None] * self.gradient
            self.blend = (1.0 if self.blend is None else self.blend) / share
        positive = torch.ones_like(self.vertices[:, 0]) if weights is None else weights.cpu()
        with coarse():
            self.u = positive / positive.sum()
            self.a = self.u[:, None] * self.gradient
            self.a = self.a / self.a.abs().max().clamp_min(torch.finfo(self.a.dtype).tiny)
            self.dual = dual_norm(self.a.mT, self.u, self.p)
        count = len(self.u)
        drawn = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:SAMPLE]
        self._sample = drawn.sort().values if count >= 2 * SAMPLE else None
        if self.representation.narrows:
            raise UserError(
                f"criterion.norm={p:g}: P_p is that of all columns, while points on the surface reach less; "
                "set manipulation=indirect or criterion.norm=2"
            )
        self._pair = None if mirror is None else self.representation.symmetric(mirror)
        if mirror is not None and self._pair is None:
            raise UserError(f"scenario.symmetry: representation={self.representation.name} has no symmetric setups")
        self.evaluations = self.passes = 0

    def values(self, setups: Tensor, start: Tensor | None = None, gap: float = VALUE) -> Tensor:
        """P_p [p] of setups [p, *setup], to 1e-6 unless `gap` says otherwise; arguments as for `optima`."""
        return self.optima(setups, start, gap=gap).values

    def values_and_gradients(self, setups: Tensor, start: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """P_p [p] of setups [p, *setup] and its gradients [p, *setup] in them."""
        found = self.optima(setups, start, gradients=True)
        return found.values, torch.zeros_like(setups) if found.gradients is None else found.gradients

    def definition(self, setups: Tensor) -> Tensor:
        """P_p [p] of setups [p, *setup] by the definition, `rbfevo.scoring.maxnorm` on the columns' SVD, in NumPy.

        It starts from the fast optimum and goes on until the condition of the maximum holds to rounding.
        """
        known = self.optima(setups, gap=0.0)
        values, u, a = known.values.clone(), self.u.numpy(), self.a.numpy()
        for i in torch.nonzero(known.values > 0).flatten().tolist():
            parts = self._columns(setups[i].detach().cpu().to(self.vertices.dtype))
            blocks, start = [], np.zeros(a.shape)
            for part in parts:
                Phi = part.representation.phi(self.vertices.numpy(), part.setup.numpy())
                Phi = Phi if self.blend is None else self.blend.numpy()[:, None] * Phi
                left, sigma, _ = np.linalg.svd(np.sqrt(u)[:, None] * Phi, full_matrices=False)
                kept = left[:, sigma > cutoff(*Phi.shape) * sigma[0]] / np.sqrt(u)[:, None]
                blocks.append(Block(np.array(part.components), np.linalg.qr(kept)[0]))
                weights = known.weights[i].cpu()[:, part.components]
                start[:, part.components] = Phi @ _taken(weights, part.rows).numpy()
            if self.mirror is not None and len(parts) == 1:
                blocks.append(Block(np.array([self.mirror.axis]), np.zeros((len(u), 0))))
            gain = best_displacement(blocks, a, u, self.p, start).gain
            values[i] = min((gain / dual_norm_of(a, u, self.p)) ** 2, 1.0)
        return values

    @torch.no_grad()
    def optima(
        self, setups: Tensor, start: Tensor | None = None, gradients: bool = False, gap: float = VALUE
    ) -> Optima:
        """P_p and the best displacements of setups [p, *setup]; each depends on its own setup and start alone.

        Args:
            start: [p, s + r k] `near` of similar setups, or None; they save passes and change P_p within its accuracy.
            gradients: compute gradients too, for which the optimum has to be known better.
            gap: by what share of G its bound may lie above it without gradients; 0 for values to rounding.
        """
        count, m = len(setups), self.representation.columns(setups)
        flat = setups.detach().cpu().to(self.vertices.dtype)
        values = torch.full((count,), torch.nan, dtype=flat.dtype)
        weights = torch.zeros(count, m, self.a.shape[1], dtype=flat.dtype)
        slopes, passes = torch.zeros_like(flat), torch.zeros(count, dtype=torch.long)

        def work(begin: int, end: int) -> None:
            for i in range(begin, end):
                setup = flat[i].clone()
                if not bool(torch.isfinite(setup).all()):
                    continue
                near = None if start is None else self._remembered(start[i].cpu().to(setup.dtype), setup.shape)
                found = self._one(setup, near, 0.0 if gradients else gap)
                if found is None:
                    continue
                value, weights[i], best_one, parts = found
                values[i] = value
                if best_one is not None:
                    passes[i] = best_one.passes
                    if gradients:
                        slopes[i] = self._gradient(setup, parts, weights[i], best_one)

        with coarse():
            run_in_slices(work, count)
        self.evaluations += count
        self.passes += int(passes.sum())
        sound = all_finite(slopes)
        slopes = torch.where(sound.view(-1, *(1,) * (slopes.ndim - 1)), slopes, 0.0)
        near = torch.cat((flat.flatten(1), weights.flatten(1)), dim=1)
        found = (values, weights, slopes if gradients else None, passes, near)
        return Optima(*(part if part is None else part.to(setups.device) for part in found))  # pyright: ignore[reportArgumentType]

    def _remembered(self, near: Tensor, shape: torch.Size) -> Tensor | None:
        """The displacement [k, n] of a row of `Optima.near`; None where it is not finite."""
        setup, weights = near[: shape.numel()].view(shape), near[shape.numel() :].view(-1, self.a.shape[1])
        if not bool(torch.isfinite(setup).all()):
            return None
        d = torch.zeros(self.a.mT.shape, dtype=self.a.dtype)
        for part in self._columns(setup):
            w = _taken(weights[:, part.components], part.rows)
            for these in self._steps():
                d[part.components, these] = w.mT @ self._phi(part, these).mT
        return d if bool(torch.isfinite(d).all()) else None

    def _one(
        self, setup: Tensor, start: Tensor | None, gap: float
    ) -> tuple[float, Tensor, Best | None, list[_Columns]] | None:
        """P_p of one finite setup, weights [r, k], the optimum, and the columns; None where Phi is not finite."""
        parts, bases, backs = self._columns(setup), [], []
        weights = torch.zeros(self.representation.columns(setup[None]), self.a.shape[1], dtype=setup.dtype)
        for part in parts:
            found = self._basis(part)
            if found is None:
                return None
            bases.append(Part(part.components, found[0]))
            backs.append(found[1])
        if not any(one.basis.shape[1] for one in bases):
            return 0.0, weights, None, parts
        optimum = best(bases, self.a.mT, self.u, self.p, gap, start, self._sample)
        if optimum is None:
            return 0.0, weights, None, parts
        for part, back, coordinates in zip(parts, backs, optimum.coordinates, strict=True):
            _put(weights, part, back @ coordinates)
        return min((optimum.gain / self.dual) ** 2, 1.0), weights, optimum, parts

    def _basis(self, part: _Columns) -> tuple[Tensor, Tensor] | None:
        """A basis B = Phi T [n, r] that is orthonormal where rows count with u, and T; None where Phi is not finite.

        It comes from the Gram matrix, and where that is ill-conditioned from a QR decomposition.
        """
        n, m = len(self.u), part.representation.columns(part.setup[None])
        Phi, G = torch.empty(n, m, dtype=self.u.dtype), torch.zeros(m, m, dtype=self.u.dtype)
        for these in self._steps():
            rows = Phi[these] = self._phi(part, these)
            G.addmm_(rows.mT, self.u[these, None] * rows)
        if not bool(torch.isfinite(G).all()):
            return None
        eigenvalues, vectors = torch.linalg.eigh(G)
        if float(eigenvalues[0]) > ALIKE * float(eigenvalues[-1]):
            back = vectors / eigenvalues.sqrt()
            for these in self._steps():
                Phi[these] = Phi[these] @ back
            return Phi, back
        roots = self.u.sqrt()[:, None]
        Q, R = torch.linalg.qr(roots * Phi)
        left, sigma, right = torch.linalg.svd(R)
        count = int((sigma > cutoff(n, m) * sigma[0]).sum())
        return (Q @ left[:, :count]) / roots, right[:count].mT / sigma[:count]

    def _gradient(self, setup: Tensor, parts: list[_Columns], weights: Tensor, found: Best) -> Tensor:
        """Gradient [*setup] of P_p."""
        d = found.displacement
        h = self.u * power(d.square().sum(0), 0.5 * self.p - 1.0) * d
        field = self.a.mT - found.gain * h
        if self.blend is not None:
            field = self.blend * field
        out = torch.zeros_like(setup)
        for part in parts:
            w = _taken(weights[:, part.components], part.rows)
            total = torch.zeros_like(part.setup)
            for these in self._steps():
                dPhi = (w @ field[part.components, these])[None]
                total += self._pull(part, self.vertices[these], dPhi)
            if part.rows is None or part.setup.ndim == 1:
                out += total
            else:
                out[part.rows] += total
        return out * (2.0 * found.gain / self.dual**2)

    def _pull(self, part: _Columns, points: Tensor, dPhi: Tensor) -> Tensor:
        """Gradient [*setup] of a function whose gradient in Phi^T is `dPhi` [1, r, q]."""
        closed = part.representation.pull(points, part.setup[None], dPhi)
        if closed is not None:
            return closed[0]
        with torch.enable_grad():
            leaf = part.setup[None].detach().requires_grad_()
            return torch.autograd.grad(part.representation.phi(points, leaf).mT, leaf, dPhi)[0][0]

    def _columns(self, setup: Tensor) -> list[_Columns]:
        """The columns of one setup: all components share them, but for those along and across a plane of symmetry."""
        k = self.a.shape[1]
        if self.mirror is None or self._pair is None:
            return [_Columns(list(range(k)), self.representation, setup, None)]
        axis, others = self.mirror.axis, [c for c in range(k) if c != self.mirror.axis]
        own = self.representation.off_plane()
        if own is not None:  # setups that are no centers come whole
            found = [_Columns(others, self._pair[0], setup, None)]
            return [*found, _Columns([axis], self._pair[1], setup, own)] if bool(own.any()) else found
        setup = self.mirror.snapped(setup)
        off = ~self.mirror.on_plane(setup)
        found = [_Columns(others, self._pair[0], setup, None)]
        if bool(off.any()):
            found.append(_Columns([axis], self._pair[1], setup[off], off))
        return found

    def _phi(self, part: _Columns, these: slice) -> Tensor:
        """Rows of Phi [q, r] times the blend."""
        phi = part.representation.phi(self.vertices[these], part.setup)
        return phi if self.blend is None else self.blend[these, None] * phi

    def _steps(self) -> list[slice]:
        """Slices of the vertices."""
        return [slice(begin, begin + ROWS) for begin in range(0, len(self.u), ROWS)]


def bounded_of(
    scenario: Scenario, representation: Representation | Kernel, p: float, mirror: Mirror | None = None
) -> BoundedPotential:
    """P_p of a scenario of one objective; mirror: its plane of symmetry, or None to leave it out."""
    design = scenario.vertices, scenario.gradient, representation, p
    return BoundedPotential(*design, scenario.weights, scenario.blend, mirror, scenario.max_displacement)


def _taken(weights: Tensor, rows: Tensor | None) -> Tensor:
    return weights if rows is None else weights[rows]


def _put(weights: Tensor, part: _Columns, values: Tensor) -> None:
    """Write the weights [r, c] of a part's columns into those of all [m, k]."""
    rows = torch.arange(len(weights)) if part.rows is None else torch.nonzero(part.rows).flatten()
    weights[rows[:, None], torch.tensor(part.components)] = values
