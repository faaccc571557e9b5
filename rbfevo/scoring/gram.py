"""Gram matrices of Phi for a population, accumulated over blocks of vertices without ever storing Phi."""

from __future__ import annotations

import functools
import importlib
import itertools
import types
from collections.abc import Callable

import torch
from torch import Tensor

from rbfevo.choices import EVALUATORS, refuse_others
from rbfevo.errors import UserError
from rbfevo.geometry.blocks import VertexBlocks, vertex_blocks
from rbfevo.scoring import matrices
from rbfevo.scoring.distances import distances
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland
from rbfevo.scoring.matrices import product, solve_lower
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.threads import coarse, run_in_slices

FUSED_BLOCK = 1024  # m = 25 rows of 1024 float64 are 200 KiB: half of a usual second-level cache
REACHED = 0.75  # share of pairs of a center and a block in reach from which small blocks save less than they cost
CUDA_BLOCK = 8192
EAGER_BYTES = 1 << 18  # of one temporary of an eager step on the CPU: in cache
GPU_SHARE = 16  # one temporary of an eager step takes at most one in so many parts of a GPU's free memory


@functools.cache
def _fused() -> types.ModuleType | None:
    """The numba kernels, or None where numba is missing or cannot be used (no place for its cache, say)."""
    try:
        return importlib.import_module("rbfevo.scoring.fused")
    except (ImportError, RuntimeError, OSError):
        return None


class GramAccumulator:
    """Walks over the vertices of one design and accumulates M = (Q g)^T (Q g) for every setup of a population.

    With Q = Phi, M [*pop, m+k, m+k] holds G = Phi^T Phi [m, m], b = Phi^T g [m, k] and g^T g [k, k]. With a lower
    triangular factor T [*pop, m, m], Q = Phi T^-T, as the further passes of CholeskyQR need it.

    Args:
        vertices: [n, d]; gradient: [n, k]; weights: [n] (rows of Phi and g count with sqrt(weights)).
        blend: [n] what rows of Phi, and not of g, are multiplied by, or None for ones.
        representation: what makes columns of a setup; RBFs of the kernels of `rbfevo.scoring.fused` run there.
        backend: `fused` (numba, CPU), `eager` (plain torch, any device), or `auto`: fused where it can run.
        block: vertices a block, or None for the backend's own choice.

    Raises:
        UserError: for an unknown backend, or where `fused` is asked for and cannot run.
    """

    def __init__(
        self,
        vertices: Tensor,
        gradient: Tensor,
        weights: Tensor,
        representation: Representation | Kernel,
        backend: str = "auto",
        block: int | None = None,
        blend: Tensor | None = None,
    ) -> None:
        refuse_others("evaluator", backend, EVALUATORS)
        self.representation = RBF(representation) if isinstance(representation, Kernel) else representation
        self._rbf = self.representation if isinstance(self.representation, RBF) and self.representation.plain else None
        code = None if self._rbf is None else _fused_code(vertices, self._rbf.kernel)
        possible = code is not None
        if backend == "fused" and not possible:
            raise UserError("evaluator=fused needs numba, the CPU and float64; use evaluator=eager")
        self.backend = "fused" if possible and backend != "eager" else "eager"
        self._image = None if self._rbf is None else self._rbf.image
        self._support = 0.0 if self._rbf is None else self._rbf.kernel.support or 0.0
        self.code = -1 if code is None else code
        device = vertices.device
        eager = CUDA_BLOCK if device.type == "cuda" else self.representation.block
        self.size = block or (fused_block(vertices, self._support) if self.backend == "fused" else eager)
        self._bytes = torch.cuda.mem_get_info(device)[0] // GPU_SHARE if device.type == "cuda" else EAGER_BYTES
        self.blocks: VertexBlocks = vertex_blocks(vertices, gradient, weights, self.size, blend)
        with coarse():
            gg = self.blocks.g @ self.blocks.g.T
        self._gg = (gg + gg.T) / 2.0  # to the bit: some processors round the two halves differently

    def __call__(self, centers: Tensor, factor: Tensor | None = None) -> Tensor:
        """M [p, m+k, m+k] for finite setups, as centers [p, m, d], and, if given, factors T [p, m, m].

        The centers may be on the host while the vertices are on a GPU: then M comes back to the host, which is the only
        time that the host waits for the GPU.
        """
        run = self._run_fused if self.backend == "fused" else self._run_eager
        device = self.blocks.X.device
        M = run(centers.detach().contiguous().to(device), None if factor is None else factor.to(device))
        return M.to(centers.device)

    def backward(self, centers: Tensor, dM: Tensor) -> Tensor:
        """Gradient [p, m, d] in the centers of a function of M [p, m+k, m+k] with gradient `dM`, blocks recomputed.

        dPhi = Phi (dG + dG^T) + g db^T; dc_j = sum_i dPhi_ij phi'(r_ij)/r_ij (c_j - x_i).
        """
        m = self.representation.columns(centers)
        S = dM + dM.mT
        run = self._backward_fused if self.backend == "fused" else self._backward_eager
        device = self.blocks.X.device
        pieces = (centers.detach(), S[:, :m, :m], S[:, :m, m:])
        return run(*(piece.contiguous().to(device) for piece in pieces)).to(centers.device)

    def _backward_fused(self, centers: Tensor, dG: Tensor, db: Tensor) -> Tensor:
        fused = _fused()
        if fused is None:
            raise UserError("evaluator=fused needs numba")
        out = torch.empty_like(centers)
        b = self.blocks
        fixed = (b.X.numpy(), b.W.numpy(), b.g.numpy(), b.starts.numpy(), b.low.numpy(), b.high.numpy())
        images, sign, axis = self._images(centers)
        arrays = [array.detach().numpy() for array in (centers, images, dG, db, out)]

        def work(begin: int, end: int) -> None:
            C, mirrored, left, right, into = (array[begin:end] for array in arrays)
            fused.gram_backward(C, mirrored, sign, axis, *fixed, self.code, self._support, left, right, into)

        run_in_slices(work, len(centers))
        return out

    def _backward_eager(self, centers: Tensor, dG: Tensor, db: Tensor) -> Tensor:
        out = torch.zeros_like(centers)

        def work(first: int, last: int) -> None:
            for chunk in self._chunks(centers, first, last):
                C = centers[chunk]
                for X, W, g in self._pieces:
                    rows = self.representation.phi(X.T, C).mT
                    H = (product(dG[chunk], rows * W) + product(db[chunk], g)) * W
                    found = self.representation.pull(X.T, C, H)
                    out[chunk] += self._recomputed(X.T, C, H) if found is None else found

        self._in_slices(work, len(centers), centers)
        return out

    def _run_fused(self, centers: Tensor, factor: Tensor | None) -> Tensor:
        fused = _fused()
        if fused is None:
            raise UserError("evaluator=fused needs numba")
        p, m, _ = centers.shape
        k = self.blocks.g.shape[0]
        M = torch.empty(p, m + k, m + k, dtype=centers.dtype)
        images, sign, _ = self._images(centers)
        C, mirrored, out = centers.detach().numpy(), images.detach().numpy(), M.numpy()
        T = torch.empty(0, m, m, dtype=centers.dtype).numpy() if factor is None else factor.contiguous().numpy()
        b = self.blocks
        fixed = (b.X.numpy(), b.W.numpy(), b.g.numpy(), b.starts.numpy(), b.low.numpy(), b.high.numpy())

        def work(begin: int, end: int) -> None:
            part = T if factor is None else T[begin:end]
            fused.gram(C[begin:end], mirrored[begin:end], sign, *fixed, self.code, self._support, part, out[begin:end])

        run_in_slices(work, p)
        M[:, m:, m:] = self._gg  # the kernel skips blocks that no center reaches
        return M

    def _run_eager(self, centers: Tensor, factor: Tensor | None) -> Tensor:
        p, m, k = len(centers), self.representation.columns(centers), self.blocks.g.shape[0]
        M = torch.zeros(p, m + k, m + k, dtype=centers.dtype, device=centers.device)

        def work(first: int, last: int) -> None:
            for chunk in self._chunks(centers, first, last):
                for X, W, g in self._pieces:
                    rows = self.representation.phi(X.T, centers[chunk]).mT * W
                    if factor is not None:
                        rows = solve_lower(factor[chunk], rows)
                    rows = torch.cat((rows, g.expand(len(rows), -1, -1)), dim=1)
                    M[chunk] += matrices.gram(rows)

        self._in_slices(work, p, centers)
        return M

    def _recomputed(self, points: Tensor, setups: Tensor, gradient: Tensor) -> Tensor:
        """Gradient [p, *setup] of a function whose gradient in Phi^T is [p, r, q], by autograd."""
        with torch.enable_grad():
            leaf = setups.detach().requires_grad_()
            rows = self.representation.phi(points, leaf).mT
            return torch.autograd.grad(rows, leaf, gradient)[0]

    @functools.cached_property
    def _pieces(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """X [d, size], W [size] and g [k, size] of each block, for the eager steps."""
        b = self.blocks
        cuts = itertools.pairwise(b.starts.tolist())
        return [(b.X[:, begin:end], b.W[begin:end], b.g[:, begin:end]) for begin, end in cuts]

    def _images(self, centers: Tensor) -> tuple[Tensor, float, int]:
        """Mirror images of the centers, their sign, and the axis; the centers themselves and 0 where there are none."""
        if self._image is None:
            return centers, 0.0, 0
        return self._image.mirror.image(centers), self._image.sign, self._image.mirror.axis

    def _chunks(self, centers: Tensor, first: int, last: int) -> list[slice]:
        """Slices of the population from first to last whose rows over one block fit an eager step's memory."""
        size = 8 * (self.representation.columns(centers) + self.blocks.g.shape[0]) * self.size
        step = max(1, self._bytes // size)
        return [slice(begin, min(begin + step, last)) for begin in range(first, last, step)]

    @staticmethod
    def _in_slices(work: Callable[[int, int], None], count: int, centers: Tensor) -> None:
        if centers.is_cuda:
            work(0, count)
        else:
            run_in_slices(work, count)


def fused_block(vertices: Tensor, support: float) -> int:
    """Vertices [n, d] a block for the fused passes, which skip centers whose support [model units] misses a block.

    Each pair of a setup and a block costs some hundred operations, so blocks of large designs, of which a center
    reaches few anyway, are larger. It depends on no center, so that scores do not depend on the population.

    Args:
        support: 0 for a kernel without compact support.
    """
    if support <= 0:
        return FUSED_BLOCK
    if len(vertices) > 4 * FUSED_BLOCK:
        extent = float((vertices.amax(0) - vertices.amin(0)).max())
        return FUSED_BLOCK // 2 if support <= 0.5 * extent else FUSED_BLOCK
    small = FUSED_BLOCK // 4
    none = vertices[:, :0]
    blocks = vertex_blocks(vertices, none, torch.ones_like(vertices[:, 0]), small)
    low, high = blocks.low[:, None], blocks.high[:, None]
    gap = torch.maximum(low - vertices, vertices - high).clamp_min(0.0).square().sum(2)
    reached = (gap < support**2).to(vertices.dtype).mean()
    return small if float(reached) < REACHED else FUSED_BLOCK


def kernel_columns(vertices: Tensor, kernel: Kernel) -> Callable[[Tensor], Tensor]:
    """The map from centers [c, d] to their columns phi(|c_j - x_i|) [n, c], by the fastest means there is.

    It runs on the calling thread alone: several threads may call it at once.
    """
    code = _fused_code(vertices, kernel)
    fused = _fused()
    if code is None or fused is None:
        return lambda centers: kernel(distances(vertices, centers))
    X = vertices.T.contiguous().numpy()
    support = kernel.support or 0.0

    def columns(centers: Tensor) -> Tensor:
        out = torch.empty(len(centers), len(vertices), dtype=vertices.dtype)
        fused.columns(centers.contiguous().numpy(), X, code, support, out.numpy())
        return out.T

    return columns


def _fused_code(vertices: Tensor, kernel: Kernel) -> int | None:
    """The number of the kernel in `rbfevo.scoring.fused`, or None where that cannot run on these vertices."""
    fits = vertices.device.type == "cpu" and vertices.dtype == torch.float64 and vertices.shape[1] in (2, 3)
    code = {Wendland: 0, ThinPlate: 1, Cubic: 2}.get(type(kernel))
    return code if fits and _fused() is not None else None
