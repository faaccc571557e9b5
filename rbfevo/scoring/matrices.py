"""Linear algebra on batches of small matrices, in which every result depends on its own matrix alone.

BLAS and LAPACK promise the same bits for the same numbers only if arrays are aligned alike and the threads are as many
(MKL's "Conditional numerical reproducibility", without a setting of it). In a batch of 25 x 25 matrices every matrix
starts at another place in its cache line, and on some processors rounds by it. So each function here fills its matrices
up with zeros (or with the identity) to a multiple of `ROWS` rows and columns: every matrix then starts a cache line, as
PyTorch's own memory does. And it leaves each operation one thread, since a batch is else cut by its size; of what takes
long for each matrix, threads share slices. This asks nothing of the environment. On a GPU matrices are taken as they
are.

All matrices are float64 and finite; `p` is the number of matrices. None of the functions raises for a matrix's values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rbfevo.scoring.threads import coarse, run_in_slices

ROWS = 4  # 4 x 4 float64 are two cache lines of 64 bytes
SQUARED = 1e-4  # of sigma_max
BEYOND = 2.0  # of the Frobenius norm: the eigenvalue of what is filled up, so that it comes last


@coarse()
def product(A: Tensor, B: Tensor) -> Tensor:
    """A B [p, r, c] of A [p, r, q] and B [p, q, c], one of which may be a single matrix."""
    if B.is_cuda:
        return A @ B
    p, r, c = len(B) if B.ndim == 3 else len(A), A.shape[-2], B.shape[-1]
    return _cut(_filled(A.expand(p, -1, -1)) @ _filled(B.expand(p, -1, -1)), r, c)


@coarse()
def gram(A: Tensor) -> Tensor:
    """A A^T [p, r, r] of A [p, r, q]."""
    filled = _filled(A)
    return _cut(filled @ filled.mT, A.shape[1], A.shape[1])


def all_finite(A: Tensor) -> Tensor:
    """Whether all values of A [p, ...] are finite [p]: by their sum, which costs a twentieth of looking at each."""
    values = A.flatten(1)
    found = values.sum(1).isfinite()
    if not bool(found.all()):  # sums of large numbers can overflow
        found = values.isfinite().all(1)
    return found


@coarse()
def cholesky(G: Tensor) -> tuple[Tensor, Tensor]:
    """Lower factors [p, m, m] of G [p, m, m], the identity where there is none, and whether there is one [p]."""
    m = G.shape[-1]
    upper, info = torch.linalg.cholesky_ex(_filled(G, identity=True), upper=True)
    L = _cut(upper.mT, m, m)
    sound = (info == 0) & all_finite(L)
    return torch.where(sound[:, None, None], L, torch.eye(m, dtype=G.dtype, device=G.device)), sound


@coarse()
def solve_lower(L: Tensor, B: Tensor, transposed: bool = False) -> Tensor:
    """L^-1 B [p, m, k], or L^-T B, of lower triangular L [p, m, m] and B [p, m, k]."""
    T = _filled(L, identity=True)
    # From the right, with all matrices transposed: rows then stay rows.
    found = torch.linalg.solve_triangular(T if transposed else T.mT, _filled(B).mT, upper=not transposed, left=False)
    return _cut(found.mT, *B.shape[1:])


@coarse()
def solve(A: Tensor, B: Tensor) -> Tensor:
    """A^-1 B [p, m, k] of A [p, m, m] and B [p, m, k] by LU with pivots; any values, NaN too, if A is singular."""
    LU, pivots, _ = torch.linalg.lu_factor_ex(_filled(A, identity=True))
    return _cut(torch.linalg.lu_solve(LU, pivots, _filled(B)), *B.shape[1:])


@coarse()
def inverse_definite(A: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses [p, m, m] of symmetric A [p, m, m], the identity where A is not positive definite, and where it is [p].

    By Cholesky's method: a fifth of the operations of `solve` with as many right-hand sides.
    """
    m = A.shape[-1]
    L, sound = cholesky(A)
    inverse = _cut(torch.cholesky_inverse(_filled(L, identity=True)), m, m)
    return inverse, sound


def singular_values(A: Tensor) -> Tensor:
    """Singular values [p, m], falling, of A [p, m, m]."""
    return _shared(lambda A: (torch.linalg.svdvals(_filled(A))[:, : A.shape[1]],), A)[0]


def left_singular(A: Tensor) -> tuple[Tensor, Tensor]:
    """Left singular vectors [p, m, m] and singular values [p, m], falling, of A [p, m, m]."""
    m = A.shape[1]

    def work(A: Tensor) -> tuple[Tensor, Tensor]:
        left, sigma, _ = torch.linalg.svd(_filled(A))
        return _cut(left, m, m), sigma[:, :m]

    return _shared(work, A)


def left_spectrum(A: Tensor) -> tuple[Tensor, Tensor]:
    """As `left_singular`, in half the time where squares lose little: where sigma_min >= `SQUARED` sigma_max.

    There they come from the eigenvectors of A A^T, and sigma_min has a relative error of about eps (sigma_max /
    sigma_min)^2, at most 2e-8; elsewhere from the singular value decomposition.
    """
    values, vectors = eigh(gram(A))
    left, sigma = vectors.flip(2), values.flip(1).clamp_min(0.0).sqrt()
    index = torch.nonzero(~(sigma[:, -1] >= SQUARED * sigma[:, 0])).flatten()
    if len(index):
        left[index], sigma[index] = left_singular(A[index])
    return left, sigma


def eigh(C: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues [p, m], rising, and eigenvectors [p, m, m] of symmetric C [p, m, m]; zeros and I if LAPACK fails."""
    m, filled = C.shape[-1], _filled(C)
    largest = torch.finfo(C.dtype).max / BEYOND
    norm = C.flatten(1).norm(dim=1).clamp(max=largest)
    filled.diagonal(dim1=1, dim2=2)[:, m:] = BEYOND * torch.where(norm > 0, norm, 1.0)[:, None]

    def work(filled: Tensor) -> tuple[Tensor, Tensor]:
        try:
            values, vectors = torch.linalg.eigh(filled)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            if len(filled) > 1:  # one that fails takes its slice with it
                values, vectors = (torch.cat(parts) for parts in zip(*map(work, filled.split(1)), strict=True))
                return values, vectors
            values = filled.new_zeros(1, m)
            vectors = torch.eye(m, dtype=C.dtype, device=C.device)[None]
        return values[:, :m], _cut(vectors, m, m)

    return _shared(work, filled)


def _shared(work: Callable[..., tuple[Tensor, ...]], *batches: Tensor) -> Any:
    """The results of some work on batches [p, ., .] of matrices, slices of which the threads share."""
    found: dict[int, tuple[Tensor, ...]] = {}

    def piece(begin: int, end: int) -> None:
        found[begin] = work(*(batch[begin:end] for batch in batches))

    if batches[0].is_cuda:
        return work(*batches)
    run_in_slices(piece, len(batches[0]))
    pieces = [found[begin] for begin in sorted(found)]
    if len(pieces) == 1:
        return tuple(part.contiguous() for part in pieces[0])
    return tuple(torch.cat(parts) for parts in zip(*pieces, strict=True))


def _filled(A: Tensor, identity: bool = False) -> Tensor:
    """A copy of A [p, r, c] at a new address, filled up with zeros, or the identity, to multiples of `ROWS`."""
    if A.is_cuda:
        return A
    p, r, c = A.shape
    if r % ROWS == 0 and c % ROWS == 0:
        return A.clone(memory_format=torch.contiguous_format)
    out = A.new_zeros(p, -(-r // ROWS) * ROWS, -(-c // ROWS) * ROWS)
    out[:, :r, :c] = A
    if identity:
        out.diagonal(dim1=1, dim2=2)[:, min(r, c) :] = 1.0
    return out


def _cut(A: Tensor, r: int, c: int) -> Tensor:
    """The first r rows and c columns of A [p, ., .], contiguous."""
    return A[:, :r, :c].contiguous()
