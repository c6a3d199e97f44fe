"""Sparse symmetric systems of 3 x 3 blocks, factorised to the same bytes on every machine.

A = L D L^T by blocks, without pivoting: A must be positive definite. The fill-reducing order of
elimination comes from SuperLU by way of SciPy (multiple minimum degree; integers only). The numbers
are not left to it: its kernels, as those of every BLAS, are picked by CPU type and differ in the
last place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from vibrissa.numerics import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Small = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Structure:
    """Where the blocks of A and L are; made once for a graph, used for every factorisation.

    place int64[n]: when each node is eliminated. start int64[n + 1], row int32[l]: column c of L
    has its blocks in rows row[start[c]:start[c + 1]], ascending, all below c; both are counted in
    order of elimination. pair_slot int64[m]: the block of L where A's off-diagonal block of pair
    (a, b) goes, and pair_swap bool[m] whether it is the block (b, a), to be transposed.
    """

    place: Ints
    start: Ints
    row: Small
    pair_slot: Ints
    pair_swap: NDArray[np.bool_]


def analyse(nodes: int, pairs: NDArray[np.int32]) -> Structure:
    """The structure for `nodes` nodes and off-diagonal blocks at pairs int32[m, 2], each once."""
    place = _order(nodes, pairs)
    a, b = place[pairs[:, 0]], place[pairs[:, 1]]
    low, high = np.minimum(a, b), np.maximum(a, b)
    by_column = np.lexsort((high, low))
    start = np.zeros(nodes + 1, dtype=np.int64)
    np.cumsum(np.bincount(low, minlength=nodes), out=start[1:])
    l_start, l_row = _fill(nodes, start, high[by_column].astype(np.int32))
    slot = _find(l_start, l_row, low, high)
    return Structure(place, l_start, l_row, slot, a < b)


def _order(nodes: int, pairs: NDArray[np.int32]) -> Ints:
    """When each node is eliminated, int64[n]."""
    if nodes < 3:
        return np.arange(nodes, dtype=np.int64)
    degree = np.bincount(pairs.ravel(), minlength=nodes)
    rows = np.concatenate([pairs[:, 0], pairs[:, 1], np.arange(nodes)])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0], np.arange(nodes)])
    values = np.concatenate([np.full(2 * len(pairs), -1.0), degree + 1.0])
    matrix = sparse.csc_matrix((values, (rows, columns)), shape=(nodes, nodes))
    options = {"SymmetricMode": True}
    found = sparse_linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return np.asarray(found.perm_c, dtype=np.int64)


@compiled
def _fill(nodes: int, start: Ints, row: Small) -> tuple[Ints, Small]:
    """The columns of L: those of A's lower triangle, and what elimination fills in."""
    parent = np.full(nodes, -1, dtype=np.int64)
    first_child = np.full(nodes, -1, dtype=np.int64)
    next_child = np.full(nodes, -1, dtype=np.int64)
    seen = np.full(nodes, -1, dtype=np.int64)
    l_start = np.zeros(nodes + 1, dtype=np.int64)
    l_row = np.empty(max(4 * row.shape[0], 64), dtype=np.int32)
    used = 0
    for c in range(nodes):
        begin = used
        seen[c] = c
        needed = start[c + 1] - start[c]
        child = first_child[c]
        while child >= 0:
            needed += l_start[child + 1] - l_start[child]
            child = next_child[child]
        if used + needed > l_row.shape[0]:
            larger = np.empty(2 * (used + needed), dtype=np.int32)
            larger[:used] = l_row[:used]
            l_row = larger
        for p in range(start[c], start[c + 1]):
            if seen[row[p]] != c:
                seen[row[p]] = c
                l_row[used] = row[p]
                used += 1
        child = first_child[c]
        while child >= 0:
            for p in range(l_start[child], l_start[child + 1]):
                r = l_row[p]
                if seen[r] != c:
                    seen[r] = c
                    l_row[used] = r
                    used += 1
            child = next_child[child]
        l_row[begin:used].sort()
        l_start[c + 1] = used
        if used > begin:
            above = l_row[begin]
            parent[c] = above
            next_child[c] = first_child[above]
            first_child[above] = c
    return l_start, l_row[:used].copy()


@compiled
def _find(start: Ints, row: Small, low: Ints, high: Ints) -> Ints:
    slot = np.empty(low.shape[0], dtype=np.int64)
    for p in range(low.shape[0]):
        begin, end = start[low[p]], start[low[p] + 1]
        slot[p] = begin + np.searchsorted(row[begin:end], high[p])
    return slot


@compiled
def factorise(start: Ints, row: Small, diagonal: Floats, lower: Floats) -> bool:
    """Replace A by its factors, in place; False when A isn't positive definite.

    diagonal float64[n, 3, 3] and lower float64[l, 3, 3] hold A on entry (absent blocks zero), the
    inverses of D and the blocks of L afterwards.
    """
    nodes = diagonal.shape[0]
    raw = np.empty((3, 3))
    for c in range(nodes):
        if not invert(diagonal[c]):
            return False
        inverse = diagonal[c]
        for p in range(start[c], start[c + 1]):
            block = lower[p]
            for i in range(3):
                for j in range(3):
                    raw[i, j] = block[i, j]
            for i in range(3):
                for j in range(3):
                    block[i, j] = (
                        raw[i, 0] * inverse[0, j]
                        + raw[i, 1] * inverse[1, j]
                        + raw[i, 2] * inverse[2, j]
                    )
            # column `row[p]` has all rows of this one below it; earlier blocks of this column are
            # scaled already, which is what its own diagonal block needs
            _subtract(diagonal[row[p]], block, raw)
            target = start[row[p]]
            for q in range(p + 1, start[c + 1]):
                while row[target] != row[q]:
                    target += 1
                # lower[q] is not scaled yet: A_q (L_p)^T
                _subtract(lower[target], lower[q], block)
    return True


@compiled
def _subtract(target: Floats, a: Floats, b: Floats) -> None:
    """target -= a b^T."""
    for i in range(3):
        for j in range(3):
            target[i, j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@compiled
def invert(block: Floats) -> bool:
    """A symmetric positive definite 3 x 3 block by its inverse, in place."""
    a, b, c = block[0, 0], block[1, 0], block[2, 0]
    d, e, f = block[1, 1], block[2, 1], block[2, 2]
    df, ce, be = d * f - e * e, c * e - b * f, b * e - c * d
    minor = a * d - b * b
    determinant = a * df + b * ce + c * be
    if not (a > 0.0 and minor > 0.0 and determinant > 0.0):
        return False
    block[0, 0], block[1, 1], block[2, 2] = (
        df / determinant,
        (a * f - c * c) / determinant,
        minor / determinant,
    )
    block[1, 0] = block[0, 1] = ce / determinant
    block[2, 0] = block[0, 2] = be / determinant
    block[2, 1] = block[1, 2] = (b * c - a * e) / determinant
    return True


@compiled
def solve(place: Ints, start: Ints, row: Small, diagonal: Floats, lower: Floats, b: Floats) -> None:
    """Solve A x = b with the factors; b float64[n, 3] becomes x."""
    nodes = b.shape[0]
    x = np.empty((nodes, 3))
    for node in range(nodes):
        for i in range(3):
            x[place[node], i] = b[node, i]
    for c in range(nodes):
        for p in range(start[c], start[c + 1]):
            r = row[p]
            for i in range(3):
                x[r, i] -= (
                    lower[p, i, 0] * x[c, 0] + lower[p, i, 1] * x[c, 1] + lower[p, i, 2] * x[c, 2]
                )
    part = np.empty(3)
    for c in range(nodes - 1, -1, -1):
        for i in range(3):
            part[i] = (
                diagonal[c, i, 0] * x[c, 0]
                + diagonal[c, i, 1] * x[c, 1]
                + diagonal[c, i, 2] * x[c, 2]
            )
        for p in range(start[c], start[c + 1]):
            r = row[p]
            for i in range(3):
                part[i] -= (
                    lower[p, 0, i] * x[r, 0] + lower[p, 1, i] * x[r, 1] + lower[p, 2, i] * x[r, 2]
                )
        for i in range(3):
            x[c, i] = part[i]
    for node in range(nodes):
        for i in range(3):
            b[node, i] = x[place[node], i]
