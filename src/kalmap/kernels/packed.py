"""A symmetric matrix as its lower triangle, row after row: entry (i, j <= i) at i (i + 1) / 2 + j.

Half the memory of a square, exactly symmetric by construction, and it grows by appending rows.
"""

import numpy as np
from numba import njit

from kalmap.kernels.compiled import compiled

_FAST = {"contract", "reassoc", "nsz"}  # what vectorisation needs, NaN and inf kept honest
_SMALL = 176  # below this size setting up a strip costs more than it saves
_STRIP = 2048  # columns at a time: four rows fit the second-level cache, and runs are long enough to prefetch


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _rank4_on_four_rows(p0, p1, p2, p3, left, right, k, i, j0, m):
    """Add left[k:k+4, i:i+4]' right[k:k+4, j0:j0+m] to four row pieces: 16 products a load of four."""
    a00, a01, a02, a03 = left[k, i], left[k, i + 1], left[k, i + 2], left[k, i + 3]
    a10, a11, a12, a13 = left[k + 1, i], left[k + 1, i + 1], left[k + 1, i + 2], left[k + 1, i + 3]
    a20, a21, a22, a23 = left[k + 2, i], left[k + 2, i + 1], left[k + 2, i + 2], left[k + 2, i + 3]
    a30, a31, a32, a33 = left[k + 3, i], left[k + 3, i + 1], left[k + 3, i + 2], left[k + 3, i + 3]
    r0 = right[k, j0 : j0 + m]
    r1 = right[k + 1, j0 : j0 + m]
    r2 = right[k + 2, j0 : j0 + m]
    r3 = right[k + 3, j0 : j0 + m]
    for j in range(m):
        x0, x1, x2, x3 = r0[j], r1[j], r2[j], r3[j]
        p0[j] += a00 * x0 + a10 * x1 + a20 * x2 + a30 * x3
        p1[j] += a01 * x0 + a11 * x1 + a21 * x2 + a31 * x3
        p2[j] += a02 * x0 + a12 * x1 + a22 * x2 + a32 * x3
        p3[j] += a03 * x0 + a13 * x1 + a23 * x2 + a33 * x3


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _rank2_on_four_rows(p0, p1, p2, p3, left, right, k, i, j0, m):
    """The same with two factors, for what a rank that is no multiple of four leaves over."""
    a00, a01, a02, a03 = left[k, i], left[k, i + 1], left[k, i + 2], left[k, i + 3]
    a10, a11, a12, a13 = left[k + 1, i], left[k + 1, i + 1], left[k + 1, i + 2], left[k + 1, i + 3]
    r0 = right[k, j0 : j0 + m]
    r1 = right[k + 1, j0 : j0 + m]
    for j in range(m):
        x0, x1 = r0[j], r1[j]
        p0[j] += a00 * x0 + a10 * x1
        p1[j] += a01 * x0 + a11 * x1
        p2[j] += a02 * x0 + a12 * x1
        p3[j] += a03 * x0 + a13 * x1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _rank4_on_row(packed, row, left, right, k):
    """Add left[k:k+4, row]' right[k:k+4, :row+1] to one row: no slices, whose set-up dominates small matrices."""
    a0, a1, a2, a3 = left[k, row], left[k + 1, row], left[k + 2, row], left[k + 3, row]
    start = row * (row + 1) // 2
    for j in range(row + 1):
        packed[start + j] += (
            a0 * right[k, j] + a1 * right[k + 1, j] + a2 * right[k + 2, j] + a3 * right[k + 3, j]
        )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def add_outer(packed, n, left, right, rank):
    """packed += left' right on the lower triangle of the leading n x n part, in one pass over it.

    left, right: (>= rank, >= n); `rank` is even. The caller sees to it that left' right is
    symmetric. O(rank n^2 / 2), no allocation.
    """
    fours = rank - rank % 4
    if n < _SMALL:
        for row in range(n):
            for k in range(0, fours, 4):
                _rank4_on_row(packed, row, left, right, k)
            _add_row_end(packed, row, 0, left, right, fours, rank)
        return
    whole = n - n % 4
    for i in range(0, whole, 4):
        o0 = i * (i + 1) // 2
        o1 = o0 + i + 1
        o2 = o1 + i + 2
        o3 = o2 + i + 3
        for j0 in range(0, i + 1, _STRIP):
            m = min(_STRIP, i + 1 - j0)
            p0 = packed[o0 + j0 : o0 + j0 + m]
            p1 = packed[o1 + j0 : o1 + j0 + m]
            p2 = packed[o2 + j0 : o2 + j0 + m]
            p3 = packed[o3 + j0 : o3 + j0 + m]
            for k in range(0, fours, 4):
                _rank4_on_four_rows(p0, p1, p2, p3, left, right, k, i, j0, m)
            if fours < rank:
                _rank2_on_four_rows(p0, p1, p2, p3, left, right, fours, i, j0, m)
        for row in range(i + 1, i + 4):
            _add_row_end(packed, row, i + 1, left, right, 0, rank)
    for row in range(whole, n):
        _add_row_end(packed, row, 0, left, right, 0, rank)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _add_row_end(packed, row, first, left, right, factor, rank):
    """The entries (row, first..row) of the factors from `factor` on, which the larger steps leave over."""
    start = row * (row + 1) // 2
    for k in range(factor, rank):
        a = left[k, row]
        for j in range(first, row + 1):
            packed[start + j] += a * right[k, j]


@compiled
def _transform_three(packed, n, phi):
    """`transform_leading` for d = 3, in registers: then the cache misses of several rows overlap."""
    a, b, c = phi[0, 0], phi[0, 1], phi[0, 2]
    d, e, f = phi[1, 0], phi[1, 1], phi[1, 2]
    g, h, k = phi[2, 0], phi[2, 1], phi[2, 2]
    for i in range(3, n):
        start = i * (i + 1) // 2
        x, y, t = packed[start], packed[start + 1], packed[start + 2]
        packed[start] = a * x + b * y + c * t
        packed[start + 1] = d * x + e * y + f * t
        packed[start + 2] = g * x + h * y + k * t


@compiled
def transform_leading(packed, n, d, phi):
    """Carry the cross-covariance of the leading d entries along: rows i >= d get P[i, :d] <- phi P[i, :d].

    phi becomes the identity: it has been used up.
    """
    first = d
    if d == 3:
        _transform_three(packed, n, phi)
        first = n
    old = np.empty(d)
    for i in range(first, n):
        start = i * (i + 1) // 2
        for c in range(d):
            old[c] = packed[start + c]
        for r in range(d):
            total = 0.0
            for c in range(d):
                total += phi[r, c] * old[c]
            packed[start + r] = total
    for r in range(d):
        for c in range(d):
            phi[r, c] = 1.0 if r == c else 0.0


@compiled
def remove(packed, vector, n, first, count):
    """Marginalise entries first..first+count out: drop these rows and columns in place. Returns the new n."""
    write = first * (first + 1) // 2
    for i in range(first + count, n):
        start = i * (i + 1) // 2
        for j in range(i + 1):
            if j < first or j >= first + count:
                packed[write] = packed[start + j]
                write += 1
        vector[i - count] = vector[i]
    return n - count


@compiled
def unpack(packed, n, out):
    """Write the leading n x n part as a full symmetric matrix into `out`."""
    position = 0
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = packed[position]
            out[j, i] = packed[position]
            position += 1


@compiled
def pack(full, n, out):
    """Write the lower triangle of `full` into `out`."""
    position = 0
    for i in range(n):
        for j in range(i + 1):
            out[position] = full[i, j]
            position += 1
