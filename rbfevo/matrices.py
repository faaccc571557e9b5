"""Linear algebra on batches of small matrices, in which every result depends on its own matrix alone.

BLAS and LAPACK promise the same bits for the same numbers only if arrays are aligned alike and the threads are as many
(MKL's "Conditional numerical reproducibility", without a setting of it). In a batch of 25 x 25 matrices every matrix
starts at another place in its cache line, and on some processors rounds by it. So each function here fills its matrices
up with zeros (or with the identity) to a multiple of `ROWS` rows and columns: every matrix then starts a cache line, as
PyTorch's own memory does. And it leaves each operation one thread, since a batch is else cut by its size. This asks
nothing of the environment; `docs/reliability.md` says what it costs. On a GPU matrices are taken as they are.

All matrices are float64 and finite; `p` is the number of matrices. None of the functions raises for a matrix's values.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rbfevo.threads import coarse, run_in_slices

ROWS = 4  # 4 x 4 float64 are two cache lines of 64 bytes
BEYOND = 2.0  # of the Frobenius norm: the eigenvalue of what is filled up, so that it comes last


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B [p, r, c] of A [p, r, q] and B [p, q, c], one of which may be a single matrix."""
    if B.is_cuda:
        return A @ B
    p, r, c = len(B) if B.ndim == 3 else len(A), A.shape[-2], B.shape[-1]
    with coarse():
        return _cut(_filled(A.expand(p, -1, -1)) @ _filled(B.expand(p, -1, -1)), r, c)


def gram(A: Tensor) -> Tensor:
    """A A^T [p, r, r] of A [p, r, q]."""
    with coarse():
        filled = _filled(A)
        return _cut(filled @ filled.mT, A.shape[1], A.shape[1])


def cholesky(G: Tensor) -> tuple[Tensor, Tensor]:
    """Lower factors [p, m, m] of G [p, m, m], the identity where there is none, and whether there is one [p]."""
    m = G.shape[-1]
    with coarse():
        L, info = torch.linalg.cholesky_ex(_filled(G, identity=True))
    L = _cut(L, m, m)
    sound = (info == 0) & torch.isfinite(L).flatten(1).all(1)
    return torch.where(sound[:, None, None], L, torch.eye(m, dtype=G.dtype, device=G.device)), sound


def solve_lower(L: Tensor, B: Tensor, transposed: bool = False) -> Tensor:
    """L^-1 B [p, m, k], or L^-T B, of lower triangular L [p, m, m] and B [p, m, k]."""
    with coarse():
        T = _filled(L, identity=True)
        found = torch.linalg.solve_triangular(T.mT if transposed else T, _filled(B), upper=transposed)
    return _cut(found, *B.shape[1:])


def solve(A: Tensor, B: Tensor) -> Tensor:
    """A^-1 B [p, m, k] of A [p, m, m] and B [p, m, k] by LU with pivots; any values, NaN too, if A is singular."""
    with coarse():
        LU, pivots, _ = torch.linalg.lu_factor_ex(_filled(A, identity=True))
        found = torch.linalg.lu_solve(LU, pivots, _filled(B))
    return _cut(found, *B.shape[1:])


def singular_values(A: Tensor) -> Tensor:
    """Singular values [p, m], falling, of A [p, m, m]."""
    if A.is_cuda:
        return torch.linalg.svdvals(A)
    filled, out = _filled(A), torch.empty_like(A[..., 0])

    def work(begin: int, end: int) -> None:
        out[begin:end] = torch.linalg.svdvals(filled[begin:end])[:, : A.shape[1]]

    with coarse():
        run_in_slices(work, len(A))  # LAPACK takes one at a time, so threads share them
    return out


def left_singular(A: Tensor) -> tuple[Tensor, Tensor]:
    """Left singular vectors [p, m, m] and singular values [p, m], falling, of A [p, m, m]."""
    if A.is_cuda:
        return torch.linalg.svd(A)[:2]
    filled, vectors, values = _filled(A), torch.empty_like(A), torch.empty_like(A[..., 0])
    m = A.shape[1]

    def work(begin: int, end: int) -> None:
        left, sigma, _ = torch.linalg.svd(filled[begin:end])
        vectors[begin:end], values[begin:end] = left[:, :m, :m], sigma[:, :m]

    with coarse():
        run_in_slices(work, len(A))
    return vectors, values


def eigh(C: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues [p, m], rising, and eigenvectors [p, m, m] of symmetric C [p, m, m]; zeros and I if LAPACK fails."""
    m, filled = C.shape[-1], _filled(C)
    largest = torch.finfo(C.dtype).max / BEYOND
    norm = C.flatten(1).norm(dim=1).clamp(max=largest)
    filled.diagonal(dim1=1, dim2=2)[:, m:] = BEYOND * torch.where(norm > 0, norm, 1.0)[:, None]
    with coarse():
        try:
            values, vectors = torch.linalg.eigh(filled)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            if len(C) > 1:  # one that fails takes the batch with it
                values, vectors = (torch.cat(parts) for parts in zip(*(eigh(one[None]) for one in C), strict=True))
                return values, vectors
            values = C.new_zeros(filled.shape[:2])
            vectors = torch.eye(filled.shape[1], dtype=C.dtype, device=C.device)[None]
    return values[:, :m].contiguous(), _cut(vectors, m, m)


def _filled(A: Tensor, identity: bool = False) -> Tensor:
    """A copy of A [p, r, c] at a new address, filled up with zeros, or the identity, to multiples of `ROWS`."""
    if A.is_cuda:
        return A
    p, r, c = A.shape
    out = A.new_zeros(p, -(-r // ROWS) * ROWS, -(-c // ROWS) * ROWS)
    out[:, :r, :c] = A
    if identity:
        out.diagonal(dim1=1, dim2=2)[:, min(r, c) :] = 1.0
    return out


def _cut(A: Tensor, r: int, c: int) -> Tensor:
    """The first r rows and c columns of A [p, ., .], contiguous."""
    return A[:, :r, :c].contiguous()
