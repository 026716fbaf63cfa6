"""Evaluation of a polynomial surface on the pixels of a detector."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(nogil=True, cache=True, error_model="numpy")
def chebyshev_surface(y_terms, coefficients, x_terms):
    """Return the surface sum_kl y_terms[y, k] coefficients[k, l] x_terms[l, x], float32.

    A product of matrices would do, but its last bits depend on the size of the matrices.

    Parameters
    ----------
    y_terms : ndarray, shape (ny, k)
        Polynomials at each row.
    coefficients : ndarray, shape (k, l)
    x_terms : ndarray, shape (l, nx), float32
        Polynomials at each column.
    """
    out = np.zeros((len(y_terms), x_terms.shape[1]), np.float32)
    for y in range(len(y_terms)):
        for term in range(coefficients.shape[1]):
            total = 0.0
            for k in range(coefficients.shape[0]):
                total += y_terms[y, k] * coefficients[k, term]
            factor = np.float32(total)
            for x in range(x_terms.shape[1]):
                out[y, x] += factor * x_terms[term, x]
    return out
