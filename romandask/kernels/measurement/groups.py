"""Friends of friends: links on a grid, minimum spanning forests, and the groups of any length that they hold."""

from __future__ import annotations

import numba
import numpy as np

from romandask.model.sky import ARCSEC, chord


def links(vectors: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (m, 2) of rows of unit vectors (n, 3) that are no further apart than `length` arcsec, and their
    separations (m,) in arcsec.

    Objects are sorted by the cells, `length` wide, of a grid in space: each is compared with those of its own cell and
    of half of the cells around it, so that no pair is met twice.
    """
    limit = chord(length)
    # a cell of room on either side: no row of cells runs into the next
    side = int(2 / limit) + 3
    cells = ((vectors + 1) / limit).astype(np.int64) + 1
    key = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    order = np.argsort(key, kind="stable")
    pairs, gap2 = _near(key[order], np.ascontiguousarray(vectors[order]), limit**2, side)
    return order[pairs], 2 * np.arcsin(np.sqrt(gap2) / 2) / ARCSEC


@numba.njit(nogil=True, cache=True)
def _near(key, vectors, limit2, side):
    n, count = len(key), 0
    pairs, gaps = np.empty((n + 16, 2), np.int64), np.empty(n + 16)
    for dx, dy in ((0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):
        # three cells in a row of the third axis follow one another; the first of them moves on with the object
        first, shift = 0, (dx * side + dy) * side
        for i in range(n):
            low, high = key[i] + shift - 1, key[i] + shift + 1
            if shift == 0:
                first = i + 1
            while first < n and key[first] < low:
                first += 1
            j = first
            while j < n and key[j] <= high:
                x, y, z = vectors[i, 0] - vectors[j, 0], vectors[i, 1] - vectors[j, 1], vectors[i, 2] - vectors[j, 2]
                gap2 = x * x + y * y + z * z
                if gap2 <= limit2:
                    if count == len(gaps):
                        more_pairs, more_gaps = np.empty((2 * count, 2), np.int64), np.empty(2 * count)
                        more_pairs[:count], more_gaps[:count] = pairs, gaps
                        pairs, gaps = more_pairs, more_gaps
                    pairs[count, 0], pairs[count, 1], gaps[count] = i, j, gap2
                    count += 1
                j += 1
    return pairs[:count], gaps[:count]


def forest(count: int, pairs: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum spanning forest of links as (into, joined): how groups grow together, shortest links first.

    A group is named after its first row. When a link of separation `gap` brings two together, the name of the one with
    the later row ends: `into` (count,) is the row whose group it becomes part of, `joined` the separation, infinite
    for a row whose name never ends. What separations follow from row to row do not decrease, so that the groups of a
    length are found by following them as long as they do not exceed it.

    Parameters
    ----------
    pairs, gap : (m, 2) and (m,): linked rows and their separations
    """
    order = np.argsort(gap, kind="stable")
    return _grow(count, pairs[order], gap[order])


@numba.njit(nogil=True, cache=True)
def _grow(count, pairs, gap):
    root, into, joined = np.arange(count), np.arange(count), np.full(count, np.inf)
    for k in range(len(gap)):
        a, b = pairs[k, 0], pairs[k, 1]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        if a != b:
            a, b = min(a, b), max(a, b)
            root[b] = into[b] = a
            joined[b] = gap[k]
    return into, joined


def label(into: np.ndarray, joined: np.ndarray, length: float) -> np.ndarray:
    """Return the first row of each row's group (n,) for a linking length no longer than the forest's."""
    rows = np.arange(len(into))
    target = np.where(joined <= length, into, rows)
    while True:
        further = target[target]
        if np.array_equal(further, target):
            return target
        target = further
