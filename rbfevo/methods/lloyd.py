"""Lloyd's algorithm: spread the centers evenly over the vertices, for high regularity.

Lloyd, "Least squares quantization in PCM", IEEE Trans. Inf. Theory 28(2), 1982, from greedy k-means++ starts (Arthur &
Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007); section 7 of the paper. All starts run as one
batch of tensors.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.method import Heuristic, Problem, at_least_one

_COARSE = 4096  # vertices on which the starts are drawn and run first
_BLOCK = 2**17  # distances computed at a time: few enough to stay in the cache


@torch.no_grad()
def lloyd(
    vertices: Tensor,
    count: int,
    *,
    generator: torch.Generator,
    weights: Tensor | None = None,
    starts: int = 10,
    iterations: int = 100,
    tolerance: float = 1e-3,
    kept: Tensor | None = None,
) -> Tensor:
    """Return the k-means centers [count, d] of `vertices` [n, d], which minimize the (weighted) inertia locally.

    Every start runs until the squares of its centers' moves sum to at most `tolerance` times the mean variance of the
    vertices along the axes, first on a random part of a large mesh, then on all of it; the one of least inertia runs on
    until no vertex changes its center. Centers are the centroids of their clusters, in unit and dtype of the vertices.
    They are not projected back: on a curved surface they lie slightly off it. A center that loses all its vertices goes
    to the vertex farthest from all other centers.

    Args:
        vertices: [n, d], model units.
        count: number of centers.
        generator: draws the starts, on the device of the vertices.
        weights: [n] positive masses of the vertices; equal if None.
        starts: number of k-means++ starts.
        iterations: bound on the iterations of each of the (at most) three descents.
        tolerance: see above.
        kept: [k, d] centers that stay where they are, beside the `count` that are placed.

    Raises:
        UserError: if `count`, `starts` or `iterations` is below 1, `count` exceeds the number of distinct vertices, or
            a weight is not positive.
    """
    if count < 1:
        raise UserError(f"Lloyd has to place at least one center, not {count}")
    if starts < 1 or iterations < 1:
        raise UserError(f"Lloyd needs at least one start and one iteration, not {starts} and {iterations}")
    if len(vertices[:_COARSE].unique(dim=0)) < count and (distinct := len(vertices.unique(dim=0))) < count:
        raise UserError(
            f"Lloyd cannot place {count} centers on {distinct} distinct vertices: "
            "ask for fewer centers or refine the mesh"
        )
    mass = vertices.new_ones(len(vertices)) if weights is None else weights
    if not bool((mass > 0).all()):
        raise UserError("Lloyd needs vertex weights that are all positive")

    middle = vertices.mean(0)  # |x|^2 - 2 x.c + |c|^2 cancels far from the origin
    X = vertices - middle
    enough = tolerance * X.var(0, correction=0).mean()
    part = torch.randperm(len(X), generator=generator, device=X.device)[:_COARSE]
    fixed = None if kept is None else kept - middle
    centers = _seed(X[part], mass[part], count, starts, generator, fixed)
    if len(part) < len(X):
        centers, _ = _descend(X[part], mass[part], centers, iterations, enough, fixed)
    centers, inertias = _descend(X, mass, centers, iterations, enough, fixed)
    best = centers[inertias.argmin()][None]
    best, _ = _descend(X, mass, best, iterations, torch.zeros_like(enough), fixed)
    return best[0] + middle


def inertia(vertices: Tensor, centers: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the (weighted) sum [*pop] of squared distances, vertices [n, d] to the nearest `centers` [*pop, m, d]."""
    square = torch.cdist(vertices, centers, compute_mode="donot_use_mm_for_euclid_dist").amin(-1).square()
    return (square if weights is None else square * weights).sum(-1)


def _seed(
    X: Tensor, mass: Tensor, count: int, starts: int, generator: torch.Generator, fixed: Tensor | None = None
) -> Tensor:
    """Draw vertices [starts, count, d], each with a chance proportional to its squared distance to those before.

    Those before include the `fixed` ones [k, d].

    Of 2 + log(count) draws the one that lowers the inertia the most is taken. Once every vertex has a center on it, the
    last vertex is repeated.
    """
    centers = X.new_empty(starts, count, X.shape[1])
    axes = X.T.contiguous()
    square = X.new_full((starts, len(X)), torch.inf)
    chance = mass.expand(starts, -1)
    if fixed is not None:
        square = _squares(axes, fixed.T).amin(0).expand(starts, -1)
        chance = square * mass
    start = torch.arange(starts, device=X.device)
    for j in range(count):
        cumulative = chance.cumsum(1)
        total = cumulative[:, -1:]
        trials = 2 + int(math.log(count)) if j else 1
        level = total * torch.rand(starts, trials, generator=generator, dtype=X.dtype, device=X.device)
        level = torch.minimum(level, total.nextafter(torch.zeros_like(total)))  # the product may round up to the total
        drawn = torch.searchsorted(cumulative, level, right=True).clamp(max=len(X) - 1)
        squares = torch.stack([torch.minimum(square, _squares(axes, axes[:, i])) for i in drawn.T])
        taken = (squares @ mass).argmin(0)
        square = squares[taken, start]
        centers[:, j] = X[drawn[start, taken]]
        chance = square * mass
    return centers


def _squares(axes: Tensor, points: Tensor) -> Tensor:
    """Squared distances [s, n] of vertices `axes` [d, n] to `points` [d, s]: exactly 0 where they coincide."""
    square = (axes[0] - points[0, :, None]).square()
    for x, p in zip(axes[1:], points[1:], strict=True):
        square += (x - p[:, None]).square()
    return square


def _descend(
    X: Tensor, mass: Tensor, centers: Tensor, iterations: int, enough: Tensor, fixed: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Move `centers` [s, m, d] to their centroids until each start rests; return them and their last inertias [s].

    Vertices nearest to one of the `fixed` centers [k, d], which do not move, belong to none of them.
    """
    centers = centers.clone()
    inertias = X.new_empty(len(centers))
    running = torch.arange(len(centers), device=X.device)
    for _ in range(iterations):
        these = centers[running]
        if fixed is not None:
            these = torch.cat((these, fixed.expand(len(running), -1, -1)), 1)
        moved, inertias[running] = _step(X, mass, these, 0 if fixed is None else len(fixed))
        shift = (moved - centers[running]).square().sum((1, 2))
        centers[running] = moved
        running = running[shift > enough]
        if len(running) == 0:
            break
    return centers, inertias


def _step(X: Tensor, mass: Tensor, centers: Tensor, fixed: int = 0) -> tuple[Tensor, Tensor]:
    """Return the centroids [s, m - fixed, d] of the vertices nearest to each center, and the inertias [s] before.

    The last `fixed` of the centers [s, m, d] do not move.
    """
    s, m, d = centers.shape
    planes = torch.cat([-2.0 * centers, centers.square().sum(-1, keepdim=True)], -1).reshape(s * m, d + 1).T
    offset = m * torch.arange(s, device=X.device)
    sums = X.new_zeros(s * m, d + 1)
    inertias = (mass @ X.square().sum(1)).repeat(s)
    rows = max(1, _BLOCK // (s * m))
    for x, w in zip(torch.cat([X, torch.ones_like(X[:, :1])], 1).split(rows), mass.split(rows), strict=True):
        lowest, label = (x @ planes).view(-1, s, m).min(-1)  # |x - c|^2 - |x|^2
        inertias += w @ lowest
        sums.index_add_(0, (label + offset).view(-1), (x * w[:, None])[:, None].expand(-1, s, -1).reshape(-1, d + 1))
    sums = sums.view(s, m, d + 1)
    free = m - fixed
    moved = torch.cat((sums[:, :free, :d] / sums[:, :free, d:], centers[:, free:]), 1)
    for i in (sums[:, :free, d] == 0).any(1).nonzero()[:, 0].tolist():
        empty = torch.cat((sums[i, :free, d] == 0, sums.new_zeros(fixed, dtype=torch.bool)))
        moved[i] = _reseed(X, moved[i], empty)
    return moved[:, :free], inertias


def towards_centroids(
    vertices: Tensor, weights: Tensor, centers: Tensor, share: Tensor, kept: Tensor | None = None
) -> Tensor:
    """Move each of the centers [s, m, d] by a share [s] of its way to the centroid of the vertices nearest to it.

    Args:
        vertices: [n, d]; weights: [n] positive masses; kept: [k, d] centers that have cells of their own and stay.
    """
    middle = vertices.mean(0)
    these = centers if kept is None else torch.cat((centers, kept.expand(len(centers), -1, -1)), 1)
    moved, _ = _step(vertices - middle, weights, these - middle, 0 if kept is None else len(kept))
    return centers + share[:, None, None] * (moved + middle - centers)


def _reseed(X: Tensor, centers: Tensor, empty: Tensor) -> Tensor:
    """Move each of the `empty` [m] among `centers` [m, d] to the vertex farthest from all others."""
    axes = X.T
    square = _squares(axes, centers[~empty].T).amin(0)
    for j in empty.nonzero()[:, 0].tolist():
        centers[j] = X[square.argmax()]
        square = torch.minimum(square, _squares(axes, centers[j, :, None])[0])
    return centers


class LloydHeuristic(Heuristic):
    """Uniform centers by Lloyd sampling, for high regularity: the best of `starts` runs of k-means on the vertices.

    Of a symmetric design it sees one half, of a planar one the vertices moved into the plane, and no vertices where no
    center may sit.
    """

    name = "lloyd"

    def __init__(self, starts: int = 10, iterations: int = 100) -> None:
        super().__init__()
        self.starts = at_least_one(f"{self.name}: starts", starts)
        self.iterations = at_least_one(f"{self.name}: iterations", iterations)

    def place(self, problem: Problem) -> Tensor:
        """[1, m, d]."""
        design = problem.scenario.half(open_only=True)
        vertices = design.vertices if design.planar is None else design.planar.pinned(design.vertices)
        centers = lloyd(
            vertices,
            problem.free,
            generator=problem.stream("lloyd"),
            weights=design.weights,
            starts=self.starts,
            iterations=self.iterations,
            kept=problem.kept_on_one_side,
        )
        return problem.assembled(self.name, centers)[None]
