"""Friends of friends: links between near objects, their minimum spanning forest, and its groups for any length."""

from __future__ import annotations

import numba
import numpy as np

from romandask.model.sky import ARCSEC, chord


def links(vectors: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of objects within a linking length.

    Objects are sorted by the cells of a grid in space that are one linking length wide. Each object is compared with
    the objects of its own cell and of half of the neighbouring cells, so that no pair is found twice.

    Parameters
    ----------
    vectors : ndarray, shape (n, 3)
        Unit vectors of the objects.
    length : float, arcsec
        Linking length.

    Returns
    -------
    pairs : ndarray, shape (m, 2)
        Rows of the two objects of each pair.
    separation : ndarray, shape (m,), arcsec
    """
    limit = chord(length)
    # one empty cell on either side, so that neighbouring keys are neighbouring cells
    side = int(2 / limit) + 3
    cells = ((vectors + 1) / limit).astype(np.int64) + 1
    key = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    order = np.argsort(key, kind="stable")
    pairs, gap2 = _near(key[order], np.ascontiguousarray(vectors[order]), limit**2, side)
    return order[pairs], 2 * np.arcsin(np.sqrt(gap2) / 2) / ARCSEC


@numba.njit(nogil=True, cache=True)
def _near(key, vectors, limit2, side):
    """Return the pairs of rows and their squared chords, for objects sorted by the key of their cell."""
    n, count = len(key), 0
    pairs, gaps = np.empty((n + 16, 2), np.int64), np.empty(n + 16)
    for dx, dy in ((0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):
        # three neighbouring cells along the third axis have consecutive keys; `first` advances with the object
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
    """Return the minimum spanning forest of links, as the merges of groups with increasing linking length.

    A group is identified by its first row. When a link merges two groups, the group with the later first row becomes
    part of the other. Along a chain of merges the separations do not decrease. The group of a row, for a given linking
    length, is therefore found by following the merges whose separation does not exceed the length (`label`).

    Parameters
    ----------
    count : int
        Number of objects.
    pairs : ndarray, shape (m, 2)
        Linked rows.
    gap : ndarray, shape (m,)
        Their separations.

    Returns
    -------
    into : ndarray, shape (count,)
        Row that identifies the group into which the group of each row is merged; the row itself if it never is.
    joined : ndarray, shape (count,)
        Separation of the link that merges the groups; infinite if the group is never merged.
    """
    order = np.argsort(gap, kind="stable")
    return _grow(count, pairs[order], gap[order])


@numba.njit(nogil=True, cache=True)
def _grow(count, pairs, gap):
    """Return `into` and `joined` for links in order of separation (union-find with path halving)."""
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
    """Return the first row of the group of each row, (n,).

    Parameters
    ----------
    into, joined : ndarray, shape (n,)
        As `forest` returns them.
    length : float
        Linking length, in the unit of `joined`, no longer than that of the links of the forest.
    """
    rows = np.arange(len(into))
    target = np.where(joined <= length, into, rows)
    while True:
        further = target[target]
        if np.array_equal(further, target):
            return target
        target = further
