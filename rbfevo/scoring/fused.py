"""Numba kernels that walk over blocks of vertices with everything in cache: Phi is never stored.

For each setup and each block of B vertices the rows phi(|c_j - x_i|) [m, B] are written into a scratch of m x B numbers
that stays in the second-level cache, the Gram matrix takes them up by 4 x 4 tiles of registers, and the next block
overwrites them. Rows of a compactly supported kernel whose block lies out of reach are skipped altogether.

The functions stand in one module, though it is long: numba keeps machine code on disk by the date of the file that a
function stands in, and would go on with old code of those that it calls from another file.

All functions release the GIL and take one slice of the population, so that a plain thread pool runs them in parallel.
Shapes: C [p, m, d] centers, X [d, n] vertices in block order, W [n] square roots of the weights, g [k, n] gradient
times W, `starts` [blocks + 1], `low` and `high` [blocks, d] the blocks' bounding boxes. All arrays float64.
"""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.core import event, types
from numba.extending import intrinsic

from rbfevo.scoring import compilation

WENDLAND, THIN_PLATE, CUBIC = 0, 1, 2

_jit = numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False, fastmath={"contract"})
# Only the sums of the Gram tiles may be reordered; NaN and infinity keep their meaning everywhere.
_jit_sum = numba.njit(nogil=True, cache=True, error_model="numpy", boundscheck=False, fastmath={"contract", "reassoc"})


class _Compilations(event.Listener):
    """Passes on that numba compiles a function of this module, which it does not where its cache has it."""

    def on_start(self, event: event.Event) -> None:
        what = event.data or {}
        if "dispatcher" in what and what["dispatcher"].py_func.__module__ == __name__:
            compilation.begins()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Compilations())


@intrinsic
def _bits(typingctx, value):
    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), codegen


@intrinsic
def _float(typingctx, value):
    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), codegen


@_jit
def _log(x):
    """Natural logarithm of a normal, finite x > 0 to about 1 ulp, free of branches and calls so that it vectorizes.

    x = 2^e z with z in [sqrt(1/2), sqrt(2)); log z = 2 artanh(t), t = (z-1)/(z+1), |t| < 0.172, an odd function.
    """
    bits = _bits(x) + (0x3FF0000000000000 - 0x3FE6A09E667F3BCD)  # pyright: ignore[reportCallIssue]
    # Exponent to double without an integer conversion, which AVX2 lacks: biased exponent in the mantissa of 2^52.
    e = _float((bits >> 52) | 0x4330000000000000) - (4503599627370496.0 + 1023.0)
    z = _float((bits & 0x000FFFFFFFFFFFFF) + 0x3FE6A09E667F3BCD)
    f = z - 1.0
    t = f / (2.0 + f)
    w = t * t
    # The minimax polynomial of fdlibm's e_log.c: three terms fewer than the Taylor series, and no worse.
    series = 1.479819860511658591e-01
    series = series * w + 1.531383769920937332e-01
    series = series * w + 1.818357216161805012e-01
    series = series * w + 2.222219843214978396e-01
    series = series * w + 2.857142874366239149e-01
    series = series * w + 3.999999999940941908e-01
    series = series * w + 6.666666666666735130e-01
    # log(1+f) = f - f^2/2 + t (f^2/2 + w series): the large part stays exact.
    h = 0.5 * f * f
    return e * 6.93147180369123816490e-01 + (f - (h - (t * (h + w * series) + e * 1.90821492927058770002e-10)))


@_jit
def _squared_distances(c, X, begin, end, out):
    size = end - begin
    if X.shape[0] == 2:
        c0, c1 = c[0], c[1]
        x0, x1 = X[0, begin:end], X[1, begin:end]
        for i in range(size):
            a, b = x0[i] - c0, x1[i] - c1
            out[i] = a * a + b * b
    else:
        c0, c1, c2 = c[0], c[1], c[2]
        x0, x1, x2 = X[0, begin:end], X[1, begin:end], X[2, begin:end]
        for i in range(size):
            a, b, e = x0[i] - c0, x1[i] - c1, x2[i] - c2
            out[i] = a * a + b * b + e * e


@_jit
def _wendland(q, inverse):
    """phi and phi'/r from the squared distance and the inverse of the support radius."""
    q = np.sqrt(q) * inverse
    u = 1.0 - q
    u = u if u > 0.0 else 0.0
    return (u * u) * (u * u) * (4.0 * q + 1.0), (-20.0 * inverse * inverse) * (u * u * u)


@_jit
def _thin_plate(q):
    """phi and phi'/r from the squared distance; 0 and 0 at r = 0."""
    log = _log(q if q > 1e-300 else 1e-300)
    return 0.5 * q * log, log + 1.0 if q > 1e-300 else 0.0


@_jit
def _cubic(q):
    """phi and phi'/r from the squared distance."""
    r = np.sqrt(q)
    return q * r, 3.0 * r


@_jit
def _phi_row(code, W, row):
    """Squared distances in `row` become phi(r) W, for the kernels without compact support."""
    if code == THIN_PLATE:
        for i in range(row.size):
            row[i] = _thin_plate(row[i])[0] * W[i]
    else:
        for i in range(row.size):
            row[i] = _cubic(row[i])[0] * W[i]


@_jit
def _fill_row(c, X, begin, end, code, support, W, row):
    """phi(r) W of the vertices from begin to end; in one loop where that is faster than two."""
    if code == THIN_PLATE or (code == CUBIC and X.shape[0] == 2):
        _squared_distances(c, X, begin, end, row)
        _phi_row(code, W, row)
    elif X.shape[0] == 2:
        c0, c1, inverse = c[0], c[1], 1.0 / support
        x0, x1 = X[0, begin:end], X[1, begin:end]
        for i in range(row.size):
            a, b = x0[i] - c0, x1[i] - c1
            row[i] = _wendland(a * a + b * b, inverse)[0] * W[i]
    else:
        c0, c1, c2 = c[0], c[1], c[2]
        x0, x1, x2 = X[0, begin:end], X[1, begin:end], X[2, begin:end]
        if code == WENDLAND:
            inverse = 1.0 / support
            for i in range(row.size):
                a, b, e = x0[i] - c0, x1[i] - c1, x2[i] - c2
                row[i] = _wendland(a * a + b * b + e * e, inverse)[0] * W[i]
        else:
            for i in range(row.size):
                a, b, e = x0[i] - c0, x1[i] - c1, x2[i] - c2
                row[i] = _cubic(a * a + b * b + e * e)[0] * W[i]


@_jit
def _fill_both(c, X, begin, end, code, support, W, row, slope):
    """phi(r) W and phi'(r)/r W of the vertices from begin to end: one square root or logarithm for both."""
    _squared_distances(c, X, begin, end, slope)
    if code == WENDLAND:
        inverse = 1.0 / support
        for i in range(row.size):
            phi, derivative = _wendland(slope[i], inverse)
            row[i], slope[i] = phi * W[i], derivative * W[i]
    elif code == THIN_PLATE:
        for i in range(row.size):
            phi, derivative = _thin_plate(slope[i])  # pyright: ignore[reportGeneralTypeIssues]
            row[i], slope[i] = phi * W[i], derivative * W[i]
    else:
        for i in range(row.size):
            phi, derivative = _cubic(slope[i])
            row[i], slope[i] = phi * W[i], derivative * W[i]


@_jit
def _reached(c, low, high, block, code, support):
    """Whether a center's support meets a block's bounding box; always for kernels without compact support."""
    if code != WENDLAND:
        return True
    gap = 0.0
    for axis in range(c.size):
        a = low[block, axis] - c[axis]
        b = c[axis] - high[block, axis]
        t = max(a, b, 0.0)
        gap += t * t
    return gap < support * support


@_jit
def _fill_block(centers, images, sign, X, begin, end, W, low, high, block, code, support, everyone, A, active):
    """Rows phi(r) W of one setup's centers that reach the block, or of `everyone`; returns how many.

    `active` takes the numbers of these centers. Rows of the mirror `images` [m, d] are added times `sign`, which is 0
    where there are none. `A` has one row more than centers, for them.
    """
    rows, size, m = 0, end - begin, centers.shape[0]
    for j in range(m):
        near = everyone or _reached(centers[j], low, high, block, code, support)
        if sign != 0.0:
            far = everyone or _reached(images[j], low, high, block, code, support)
            if not (near or far):
                continue
            row, other = A[rows, :size], A[m, :size]
            _fill_row(centers[j], X, begin, end, code, support, W[begin:end], row)
            if _same(centers[j], images[j]):  # two roundings of one value must not leave a difference
                for i in range(size):
                    row[i] += sign * row[i]
            else:
                _fill_row(images[j], X, begin, end, code, support, W[begin:end], other)
                for i in range(size):
                    row[i] += sign * other[i]
        elif near:
            _fill_row(centers[j], X, begin, end, code, support, W[begin:end], A[rows, :size])
        else:
            continue
        active[rows] = j
        rows += 1
    return rows


@_jit
def _same(a, b):
    equal = True
    for axis in range(a.size):
        equal = equal and a[axis] == b[axis]
    return equal


@_jit_sum
def _dot4x4(a0, a1, a2, a3, b0, b1, b2, b3, tile):
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
    s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
    for i in range(a0.size):
        x0, x1, x2, x3 = a0[i], a1[i], a2[i], a3[i]
        y0, y1, y2, y3 = b0[i], b1[i], b2[i], b3[i]
        s00 += x0 * y0
        s01 += x0 * y1
        s02 += x0 * y2
        s03 += x0 * y3
        s10 += x1 * y0
        s11 += x1 * y1
        s12 += x1 * y2
        s13 += x1 * y3
        s20 += x2 * y0
        s21 += x2 * y1
        s22 += x2 * y2
        s23 += x2 * y3
        s30 += x3 * y0
        s31 += x3 * y1
        s32 += x3 * y2
        s33 += x3 * y3
    tile[0, 0], tile[0, 1], tile[0, 2], tile[0, 3] = s00, s01, s02, s03
    tile[1, 0], tile[1, 1], tile[1, 2], tile[1, 3] = s10, s11, s12, s13
    tile[2, 0], tile[2, 1], tile[2, 2], tile[2, 3] = s20, s21, s22, s23
    tile[3, 0], tile[3, 1], tile[3, 2], tile[3, 3] = s30, s31, s32, s33


@_jit
def _add_gram(A, active, rows, size, tile, out):
    """out[active[a], active[b]] += A[a] . A[b] for the tiles on and below the diagonal."""
    for a in range(0, rows, 4):
        a1, a2, a3 = min(a + 1, rows - 1), min(a + 2, rows - 1), min(a + 3, rows - 1)
        for b in range(0, a + 1, 4):
            b1, b2, b3 = min(b + 1, rows - 1), min(b + 2, rows - 1), min(b + 3, rows - 1)
            _dot4x4(A[a, :size], A[a1, :size], A[a2, :size], A[a3, :size],
                    A[b, :size], A[b1, :size], A[b2, :size], A[b3, :size], tile)  # fmt: skip
            for s in range(min(4, rows - a)):
                for t in range(min(4, rows - b)):
                    if b + t <= a + s:
                        out[active[a + s], active[b + t]] += tile[s, t]


@_jit
def _solve_lower(T, rows, size, A):
    """A <- T^-1 A by forward substitution on the rows of A [rows, size]."""
    for j in range(rows):
        target = A[j, :size]
        q = 0
        while q + 4 <= j:
            t0, t1, t2, t3 = T[j, q], T[j, q + 1], T[j, q + 2], T[j, q + 3]
            r0, r1, r2, r3 = A[q, :size], A[q + 1, :size], A[q + 2, :size], A[q + 3, :size]
            for i in range(size):
                target[i] -= t0 * r0[i] + t1 * r1[i] + t2 * r2[i] + t3 * r3[i]
            q += 4
        while q < j:
            t0, r0 = T[j, q], A[q, :size]
            for i in range(size):
                target[i] -= t0 * r0[i]
            q += 1
        inverse = 1.0 / T[j, j]
        for i in range(size):
            target[i] *= inverse


@_jit
def gram(C, images, sign, X, W, g, starts, low, high, code, support, T, M):
    """M = (Q g)^T (Q g) [p, m+k, m+k] with Q = Phi T^-T, or Q = Phi where T has no rows (T [0, m, m]).

    Columns of the mirror `images` [p, m, d] are added times `sign`; where that is 0, `images` are not looked at.

    Blocks that no center reaches are skipped: g^T g lacks them.
    """
    p, m = C.shape[0], C.shape[1]
    k = g.shape[0]
    A = np.empty((m + max(k, 1), _capacity(starts)))
    active = np.empty(m + k, np.int64)
    tile = np.empty((4, 4))
    solve = T.shape[0] > 0
    for e in range(p):
        M[e] = 0.0
        for block in range(starts.size - 1):
            begin, end = starts[block], starts[block + 1]
            size = end - begin
            rows = _fill_block(
                C[e], images[e], sign, X, begin, end, W, low, high, block, code, support, solve, A, active
            )
            if rows == 0:
                continue
            if solve:
                _solve_lower(T[e], m, size, A)
            for q in range(k):
                A[rows, :size] = g[q, begin:end]
                active[rows] = m + q
                rows += 1
            _add_gram(A, active, rows, size, tile, M[e])
        for i in range(m + k):
            for j in range(i):
                M[e, j, i] = M[e, i, j]


@_jit
def _capacity(starts):
    capacity = 0
    for block in range(starts.size - 1):
        capacity = max(capacity, starts[block + 1] - starts[block])
    return capacity


@_jit
def columns(C, X, code, support, out):
    """Phi^T [c, n] for centers [c, d] and vertices [d, n], in pieces that stay in the first-level cache."""
    n = X.shape[1]
    ones = np.ones(1024)
    for j in range(C.shape[0]):
        for begin in range(0, n, 1024):
            end = min(begin + 1024, n)
            _fill_row(C[j], X, begin, end, code, support, ones[: end - begin], out[j, begin:end])


@_jit
def gram_backward(C, images, sign, axis, X, W, g, starts, low, high, code, support, dG, db, dC):
    """dC [p, m, d] from dG [p, m, m] (symmetrized by the caller: dG + dG^T) and db [p, m, k], recomputing the blocks.

    dPhi = Phi (dG + dG^T) + g db^T; dc_j = sum_i dPhi_ij phi'(r_ij)/r_ij (c_j - x_i). What reaches c_j through its
    mirror image is turned over along `axis`. A setup costs nothing where all of dG and db is 0.
    """
    p, m, d = C.shape
    capacity = _capacity(starts)
    A = np.empty((m + 1, capacity))
    S = np.empty((m + 1, capacity))
    H = np.empty((4, capacity))
    through = np.empty(d)
    active = np.empty(m, np.int64)
    for e in range(p):
        dC[e] = 0.0
        if not (dG[e].any() or db[e].any()):
            continue
        for block in range(starts.size - 1):
            begin, end = starts[block], starts[block + 1]
            size, weights = end - begin, W[begin:end]
            rows = _fill_slopes(C[e], images[e], sign, X, begin, end, W, low, high, block, code, support, A, S, active)
            for a in range(0, rows, 4):
                a1, a2, a3 = min(a + 1, rows - 1), min(a + 2, rows - 1), min(a + 3, rows - 1)
                j0, j1, j2, j3 = active[a], active[a1], active[a2], active[a3]
                h0, h1, h2, h3 = H[0, :size], H[1, :size], H[2, :size], H[3, :size]
                _combine(A, active, rows, size, dG[e], j0, j1, j2, j3, g, begin, db[e], h0, h1, h2, h3)
                for s in range(min(4, rows - a)):
                    j = active[a + s]
                    _pull(H[s, :size], S[a + s, :size], C[e, j], X, begin, dC[e, j])
                    if sign != 0.0:
                        _fill_both(images[e, j], X, begin, end, code, support, weights, A[m, :size], S[m, :size])
                        through[:] = 0.0
                        _pull(H[s, :size], S[m, :size], images[e, j], X, begin, through)
                        through[axis] = -through[axis]
                        for q in range(d):
                            dC[e, j, q] += sign * through[q]


@_jit
def _fill_slopes(centers, images, sign, X, begin, end, W, low, high, block, code, support, A, S, active):
    """As `_fill_block`, and rows phi'(r)/r W of the centers themselves in `S`."""
    m = centers.shape[0]
    size, weights = end - begin, W[begin:end]
    if sign != 0.0:
        rows = _fill_block(centers, images, sign, X, begin, end, W, low, high, block, code, support, False, A, active)
        for a in range(rows):
            _fill_both(centers[active[a]], X, begin, end, code, support, weights, A[m, :size], S[a, :size])
        return rows
    rows = 0
    for j in range(m):
        if _reached(centers[j], low, high, block, code, support):
            _fill_both(centers[j], X, begin, end, code, support, weights, A[rows, :size], S[rows, :size])
            active[rows] = j
            rows += 1
    return rows


@_jit
def _combine(A, active, rows, size, dG, j0, j1, j2, j3, g, begin, db, h0, h1, h2, h3):
    """Four rows of dPhi^T: h_s = sum_b dG[j_s, b] A[b] + sum_q db[j_s, q] g[q].

    Five rows of A are taken at a time: their 20 factors and all vectors still fit 32 registers.
    """
    for i in range(size):
        h0[i] = 0.0
        h1[i] = 0.0
        h2[i] = 0.0
        h3[i] = 0.0
    b = 0
    while b + 5 <= rows:
        r0, r1, r2, r3, r4 = A[b, :size], A[b + 1, :size], A[b + 2, :size], A[b + 3, :size], A[b + 4, :size]
        u0, u1, u2, u3, u4 = active[b], active[b + 1], active[b + 2], active[b + 3], active[b + 4]
        p0, p1, p2, p3, p4 = dG[j0, u0], dG[j0, u1], dG[j0, u2], dG[j0, u3], dG[j0, u4]
        q0, q1, q2, q3, q4 = dG[j1, u0], dG[j1, u1], dG[j1, u2], dG[j1, u3], dG[j1, u4]
        s0, s1, s2, s3, s4 = dG[j2, u0], dG[j2, u1], dG[j2, u2], dG[j2, u3], dG[j2, u4]
        t0, t1, t2, t3, t4 = dG[j3, u0], dG[j3, u1], dG[j3, u2], dG[j3, u3], dG[j3, u4]
        for i in range(size):
            x0, x1, x2, x3, x4 = r0[i], r1[i], r2[i], r3[i], r4[i]
            h0[i] += p0 * x0 + p1 * x1 + p2 * x2 + p3 * x3 + p4 * x4
            h1[i] += q0 * x0 + q1 * x1 + q2 * x2 + q3 * x3 + q4 * x4
            h2[i] += s0 * x0 + s1 * x1 + s2 * x2 + s3 * x3 + s4 * x4
            h3[i] += t0 * x0 + t1 * x1 + t2 * x2 + t3 * x3 + t4 * x4
        b += 5
    while b < rows:
        u = active[b]
        _add_row(A[b, :size], dG[j0, u], dG[j1, u], dG[j2, u], dG[j3, u], h0, h1, h2, h3)
        b += 1
    for q in range(g.shape[0]):
        _add_row(g[q, begin : begin + size], db[j0, q], db[j1, q], db[j2, q], db[j3, q], h0, h1, h2, h3)


@_jit
def _add_row(row, w0, w1, w2, w3, h0, h1, h2, h3):
    for i in range(row.size):
        x = row[i]
        h0[i] += w0 * x
        h1[i] += w1 * x
        h2[i] += w2 * x
        h3[i] += w3 * x


@_jit_sum
def _pull(h, slope, c, X, begin, out):
    """out += sum_i h_i slope_i (c - x_i)."""
    end = begin + h.size
    if c.size == 2:
        c0, c1 = c[0], c[1]
        x0, x1 = X[0, begin:end], X[1, begin:end]
        s0 = s1 = 0.0
        for i in range(h.size):
            v = h[i] * slope[i]
            s0 += v * (c0 - x0[i])
            s1 += v * (c1 - x1[i])
        out[0] += s0
        out[1] += s1
    else:
        c0, c1, c2 = c[0], c[1], c[2]
        x0, x1, x2 = X[0, begin:end], X[1, begin:end], X[2, begin:end]
        s0 = s1 = s2 = 0.0
        for i in range(h.size):
            v = h[i] * slope[i]
            s0 += v * (c0 - x0[i])
            s1 += v * (c1 - x1[i])
            s2 += v * (c2 - x2[i])
        out[0] += s0
        out[1] += s1
        out[2] += s2
