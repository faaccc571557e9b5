"""The floor under one pass of the evaluator: the Gram products and one elementwise pass, everything in cache."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import torch
from torch import Tensor

from rbfevo.scoring.kernels import Kernel, ThinPlate
from rbfevo.scoring.threads import run_in_slices

BLOCKS = (512, 1024, 2048)


class Floor:
    """The work of one pass over n vertices with m centers and k columns of g, without what depends on the setup.

    For each block [m + k, B] the kernel's costliest operation (a logarithm for r^2 log r, else a square root) is
    applied to a block of fixed numbers, and one product adds it to the Gram matrix. Threads and slices are those of the
    evaluator.
    """

    def __init__(self, n: int, m: int, k: int, kernel: Kernel, block: int) -> None:
        self.operation: Callable[..., Tensor] = torch.log if isinstance(kernel, ThinPlate) else torch.sqrt
        self.m, self.rows, self.block = m, m + k, block
        self.sizes = [end - begin for begin, end in itertools.pairwise([*range(0, n, block), n])]
        self._own = threading.local()  # each thread allocates its own blocks once

    def __call__(self, setups: int) -> None:
        run_in_slices(self._work, setups)

    def _work(self, begin: int, end: int) -> None:
        operation, (steps, M) = self.operation, self._scratch()
        for _ in range(begin, end):
            M.zero_()
            for source, target, A, transposed in steps:
                operation(source, out=target)
                M.addmm_(A, transposed)

    def _scratch(self) -> tuple[list[tuple[Tensor, Tensor, Tensor, Tensor]], Tensor]:
        """(source, target, block, its transpose) for every block of vertices, and M; allocated once per thread."""
        if not hasattr(self._own, "scratch"):
            source = torch.linspace(0.1, 2.0, self.m * self.block, dtype=torch.float64).view(self.m, self.block)
            A = torch.ones(self.rows, self.block, dtype=torch.float64)
            views = {}
            for size in set(self.sizes):
                part = A[:, :size] if size == self.block else A.new_ones(self.rows, size)
                views[size] = (source[:, :size].contiguous(), part[: self.m], part, part.T)
            M = A.new_zeros(self.rows, self.rows)
            self._own.scratch = [views[size] for size in self.sizes], M
        return self._own.scratch
