"""Friends of friends: links by k-d tree, groups as connected components, labels merged across partitions."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from romandask.model.sky import ARCSEC, chord


def links(vectors: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (m, 2) of rows of unit vectors (n, 3) that are no further apart than `length` arcsec, and their
    separations (m,) in arcsec."""
    if len(vectors) < 2:
        return np.empty((0, 2), np.int64), np.empty(0)
    pairs = cKDTree(vectors).query_pairs(chord(length), output_type="ndarray").astype(np.int64)
    gap = np.linalg.norm(vectors[pairs[:, 0]] - vectors[pairs[:, 1]], axis=1)
    return pairs, 2 * np.arcsin(gap / 2) / ARCSEC


def label(keys: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return, for each key (n,), the smallest key of its group; `pairs` (m, 2) are rows that are linked."""
    if not len(keys):
        return keys.copy()
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(keys), len(keys)))
    count, component = connected_components(graph, directed=False)
    smallest = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(smallest, component, keys)
    return smallest[component]


def merge(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (labels, merged): the labels that links across partitions touch, sorted, and the label each becomes.

    `first` and `second` (m,) are the labels at both ends of every link that crosses a border.
    """
    labels, place = np.unique(np.concatenate([first, second]), return_inverse=True)
    pairs = place.reshape(2, -1).T if len(labels) else np.empty((0, 2), np.int64)
    return labels, label(labels, pairs)


def relabel(values: np.ndarray, labels: np.ndarray, merged: np.ndarray) -> np.ndarray:
    """Return values with every label replaced by what it became."""
    if not len(labels):
        return values
    place = np.minimum(np.searchsorted(labels, values), len(labels) - 1)
    return np.where(labels[place] == values, merged[place], values)
