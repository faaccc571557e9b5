"""What is known of every candidate of orthogonal least squares, by bounds that few of them need to have sharpened.

With y = phi^T q for the newest q, w^T w falls by y^2 and w^T r by y (q^T r); y comes from columns that are kept in
single precision, and the bounds allow for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from rbfevo.scoring.threads import run_in_slices


def _empty(rows: int, n: int, device: torch.device) -> Tensor:
    """Return [rows, n] in single precision; on the CPU in the large pages that NumPy asks for: half the time."""
    if device.type == "cpu":
        return torch.from_numpy(np.empty((rows, n), np.float32))
    return torch.empty(rows, n, dtype=torch.float32, device=device)


def _largest(values: Tensor, among: Tensor, count: int) -> Tensor:
    return torch.where(among, values, -torch.inf).topk(min(count, int(among.sum()))).indices


class Screen:
    """What is known of every candidate, its column phi scaled to unit length, given the picks so far.

    `left` [c] bounds w^T w from below, `moment` [c, k] is w^T r up to `doubt` [c] in norm, `usable` [c] marks those
    that may still be picked. `reached` [groups] of `whole` [groups] is what the picks reach of the squared norm of each
    group of columns of g. A product of a unit column with a unit vector is taken to be wrong by at most `slack`: u
    for rounding each factor and sqrt(n) u for summing n terms (Higham & Mary 2019), in the precision of the product.
    """

    def __init__(
        self,
        columns: Callable[[Tensor], Tensor],
        candidates: Tensor,
        root: Tensor | None,
        residual: Tensor,
        memory: float,
        block: int,
        groups: int = 1,
    ):
        self.groups = groups
        self.whole = self._by_group(residual.square().sum(0))
        self.reached = torch.zeros_like(self.whole)
        self.columns, self.candidates, self.root, self.residual, self.block = columns, candidates, root, residual, block
        c, (n, k) = len(candidates), residual.shape
        self.rounding, rough = (torch.finfo(t).eps * (1 + math.sqrt(n) / 2) for t in (torch.float64, torch.float32))
        self.scale, self.unit, self.moment = residual.new_zeros(c), residual.new_zeros(c), residual.new_zeros(c, k)
        self.kept = _empty(min(c, int(memory // (4 * n))), n, residual.device)
        self._walk(self._survey, torch.arange(c, device=residual.device))
        self.slack = residual.new_full((c,), self.rounding)
        self.slack[: len(self.kept)] = rough
        self.usable = self.scale > 0
        self.left = self.usable.to(residual.dtype)
        self.doubt = torch.full_like(self.left, self.rounding)

    def _walk(self, visit: Callable[[slice, Tensor, Tensor], None], indices: Tensor) -> None:
        """Call visit(where, indices[where], rows) with the weighted columns as rows [b, n], one block after the other.

        Blocks are small enough to stay in cache; threads share them.
        """

        def work(begin: int, end: int) -> None:
            for start in range(begin, end, self.block):
                where = slice(start, min(start + self.block, end))
                visit(where, indices[where], self._rows(indices[where]))

        self._share(work, len(indices))

    def _share(self, work: Callable[[int, int], None], count: int) -> None:
        """Call work(begin, end) for parts of range(count), on several threads if that is of use."""
        if self.candidates.device.type == "cpu":
            run_in_slices(work, count)
        else:
            work(0, count)

    def _rows(self, indices: Tensor) -> Tensor:
        rows = self.columns(self.candidates[indices]).detach().T  # torch.no_grad ends at its own thread
        return (rows if self.root is None else rows * self.root).contiguous()

    def _survey(self, where: slice, indices: Tensor, rows: Tensor) -> None:
        """Keep a block's columns, and what is known of them before the first pick."""
        norm = torch.linalg.vector_norm(rows, dim=1)
        scale = torch.where(norm.isfinite() & (norm > 0), 1.0 / norm, 0.0)
        self.scale[where] = scale
        self.moment[where] = (self.residual.T @ rows.T).T * scale[:, None]
        kept = self.kept[where]
        # Products with kept columns are scaled instead of these, unless single precision might not reach that far.
        far = bool(((norm > 1e18) | (norm > 0) & (norm < 1e-18)).any())
        self.unit[where] = 1.0 if far else scale
        kept.copy_((rows * scale[:, None] if far else rows)[: len(kept)])

    def _products(self, indices: Tensor, directions: Tensor) -> Tensor:
        """Return phi^T directions [b, t] for unit columns phi and directions [n, t], in double precision."""
        out = directions.new_empty(len(indices), directions.shape[1])

        def visit(where: slice, indices: Tensor, rows: Tensor) -> None:
            out[where] = (directions.T @ rows.T).T * self.scale[indices, None]

        self._walk(visit, indices)
        return out

    def _remainders(self, indices: Tensor, Q: Tensor) -> Tensor:
        """Return w [b, n], in double precision; projecting twice suffices (Giraud et al. 2005)."""
        w = self._rows(indices) * self.scale[indices, None]
        for _ in range(2):
            w.addmm_(w @ Q, Q.T, alpha=-1.0)
        return w

    def best(self, Q: Tensor, tolerance: float, vanish: float) -> tuple[int, Tensor]:
        """Return index and exact gain of the next pick, or -1 and 0 if no candidate can be used."""
        remaining = (self.residual * self.residual).sum()
        before = self._least(torch.zeros_like(self.whole)) if self.groups > 1 else torch.zeros_like(remaining)
        exact = torch.full_like(self.left, -torch.inf)  # the gains computed in full
        index = torch.arange(len(exact), device=exact.device)
        sharp = self.slack <= self.rounding  # bounds from double precision
        few, many = 4, 16
        while True:
            upper = self._upper(remaining)
            top = exact.max()
            tied = (exact >= 0) & (exact >= top - tolerance)
            first = int(tied.int().argmax()) if bool(tied.any()) else -1
            doubtful = self.usable & exact.isneginf() & (upper >= top - tolerance)
            if first >= 0:  # a later one that cannot lead the first by more than the tolerance changes nothing
                doubtful &= (index < first) | (upper > exact[first] + tolerance)
            if not bool(doubtful.any()):
                return first, exact[first] - before if first >= 0 else torch.zeros_like(remaining)
            clear = doubtful & sharp
            if first >= 0 and not bool(clear.any()):
                ahead = _largest(upper, doubtful, many)
                self._sharpen(ahead, Q)
                sharp[ahead] = True
                many = min(2 * many, 256)
                continue
            ahead = _largest(upper, clear if bool(clear.any()) else doubtful, few)
            w = self._remainders(ahead, Q)
            square, moment = (w * w).sum(1), w @ self.residual
            alive = square >= vanish
            exact[ahead] = torch.where(alive, self._gain(moment * moment, square), -torch.inf)
            self.usable[ahead[~alive]] = False
            self.left[ahead] = (square.sqrt() - self.rounding).clamp(min=0).square()
            self.moment[ahead] = moment
            self.doubt[ahead] = self.rounding
            few = min(2 * few, 128)

    def _upper(self, remaining: Tensor) -> Tensor:
        """A bound [c] from above of what each candidate would bring."""
        if self.groups == 1:
            upper = (torch.linalg.vector_norm(self.moment, dim=1) + self.doubt).square() / self.left
            return torch.where(self.left > 0, upper, torch.inf).clamp(max=remaining)
        norms = torch.linalg.vector_norm(self.moment.unflatten(1, (self.groups, -1)), dim=2)
        upper = (norms + self.doubt[:, None]).square() / self.left[:, None]
        upper = torch.where(self.left[:, None] > 0, upper, torch.inf)
        return self._least(torch.minimum(upper, self._by_group(self.residual.square().sum(0))))

    def _gain(self, moments: Tensor, square: Tensor) -> Tensor:
        """What candidates bring [b] with the squares of w^T r [b, k] and w^T w [b]: of several groups the least P."""
        if self.groups == 1:
            return moments.sum(1) / square
        return self._least(self._by_group(moments) / square[:, None])

    def _least(self, gains: Tensor) -> Tensor:
        """The least P of all groups [*] once they gain so much [*, groups] of g's squared norm."""
        shares = torch.where(self.whole > 0, (self.reached + gains) / self.whole, torch.inf)
        return shares.amin(-1)

    def _by_group(self, columns: Tensor) -> Tensor:
        """Sums [*, groups] of numbers of the columns of g [*, k]."""
        return columns.unflatten(-1, (self.groups, -1)).sum(-1)

    def _sharpen(self, indices: Tensor, Q: Tensor) -> None:
        """Bring bounds to double precision: w^T w = 1 - |Q^T phi|^2 and w^T r = phi^T r, without computing w."""
        t = Q.shape[1]
        along, moment = self._products(indices, torch.cat((Q, self.residual), dim=1)).tensor_split([t], dim=1)
        error = 2.0 * (1.0 + math.sqrt(t)) * self.rounding
        self.left[indices] = (1.0 - along.square().sum(1) - error).clamp(min=0)
        self.moment[indices] = moment
        self.doubt[indices] = 2.0 * self.rounding

    def basis_of(self, centers: Tensor, vanish: float) -> Tensor:
        """An orthonormal basis [n, r] of the columns of centers [q, d], without those that depend on earlier ones."""
        rows = self.columns(centers).detach().T
        rows = rows if self.root is None else rows * self.root
        basis = rows.new_empty(0, rows.shape[1])
        for row in rows:
            length = torch.linalg.vector_norm(row)
            w = row / torch.where(length > 0, length, 1.0)
            for _ in range(2):
                w = w - basis.T @ (basis @ w)
            square = w.square().sum()
            if bool(square.isfinite() & (square >= vanish)):
                basis = torch.cat((basis, (w / square.sqrt())[None]))
        return basis.T

    def pick(self, winner: int, Q: Tensor) -> Tensor:
        """Take `winner` out and return the unit vector q [n] that it adds to Q."""
        self.usable[winner] = False
        q = self._remainders(torch.tensor([winner], device=Q.device), Q)[0]
        return q / torch.linalg.vector_norm(q)

    def advance(self, q: Tensor) -> None:
        """Bring the bounds and r up to date with the newest q."""
        c, kept = len(self.left), len(self.kept)
        y = torch.empty_like(self.left)
        rough = q.to(self.kept.dtype)

        def work(begin: int, end: int) -> None:
            y[begin:end] = torch.mv(self.kept[begin:end], rough)

        self._share(work, kept)
        y[:kept] *= self.unit[:kept]
        if kept < c:
            y[kept:] = self._products(torch.arange(kept, c, device=q.device), q[:, None])[:, 0]
        share = q @ self.residual
        self.left -= (y.abs() + self.slack).square()
        self.moment -= torch.outer(y, share)
        self.doubt += self.slack * torch.linalg.vector_norm(share)
        self.residual = self.residual - torch.outer(q, share)
        self.reached = self.reached + self._by_group(share.square())
