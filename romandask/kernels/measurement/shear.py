"""Cosmic shear: galaxy shapes, convergence power spectrum, two-point functions and their covariance.

The sky is taken to be flat. Theory and covariance are averaged exactly over the bins of separation: the Bessel function
of a bin is its mean over the annulus (Joachimi et al. 2021, A&A 646, A129, appendix A).
"""

from __future__ import annotations

import numpy as np
from scipy.special import j1, jv

from romandask.kernels.universe.structure import K_MAX, matter_power
from romandask.model.cosmology import SPEED_OF_LIGHT, Cosmology

ELL = np.arange(2, 60_001)
"""Multipoles over which power spectra are summed; they resolve a twentieth of the smallest separation in use."""


def shapes(
    major: np.ndarray, minor: np.ndarray, angle: np.ndarray, shear1: np.ndarray, shear2: np.ndarray, kappa: np.ndarray
) -> np.ndarray:
    """Return the lensed ellipticities of galaxies.

    The ellipticity transforms with the reduced shear (Seitz & Schneider 1997).

    Parameters
    ----------
    major, minor : ndarray, shape (n,)
        Semi-axes before lensing, in any unit.
    angle : ndarray, shape (n,), degrees
        Position angle of the major axis before lensing, east of north.
    shear1, shear2, kappa : ndarray, shape (n,)
        Shear and convergence.

    Returns
    -------
    ndarray, shape (n,), complex
        Ellipticities (a - b) / (a + b) in the on-sky components of GalSim and TreeCorr.
    """
    # these components refer to an angle from west through north
    intrinsic = (major - minor) / (major + minor) * np.exp(2j * np.radians(90.0 + np.asarray(angle, float)))
    reduced = (np.asarray(shear1) + 1j * np.asarray(shear2)) / (1 - np.asarray(kappa))
    return (intrinsic + reduced) / (1 + np.conj(reduced) * intrinsic)


def convergence_power(
    edges: np.ndarray,
    counts: np.ndarray,
    ell: np.ndarray = ELL,
    cosmology: Cosmology = Cosmology(),  # noqa: B008
) -> np.ndarray:
    """Return the power spectrum of the convergence of a sample of sources.

    Computed in Limber's approximation with the non-linear matter power spectrum of camb.

    Parameters
    ----------
    edges : ndarray, shape (bins + 1,)
        Edges of redshift bins.
    counts : ndarray, shape (bins,)
        Number of sources in each bin.
    ell : ndarray, shape (m,)
        Multipoles, ascending.
    cosmology : Cosmology

    Returns
    -------
    ndarray, shape (m,)
    """
    z, share = (edges[1:] + edges[:-1]) / 2, counts / counts.sum()
    source = cosmology.comoving_distance(z)
    nodes, weights = np.polynomial.legendre.leggauss(120)
    far = cosmology.comoving_distance(edges[-1])
    chi, step = far * (nodes + 1) / 2, weights * far / 2
    redshift = cosmology.inv_comoving_distance(chi)
    lens = (share * np.clip(1 - chi[:, None] / source, 0, None)).sum(axis=1)
    hubble = 100 * cosmology.h / SPEED_OF_LIGHT
    kernel = 1.5 * cosmology.omega_m * hubble**2 * (1 + redshift) * lens
    # the spectrum is smooth in the logarithm: compute it at some two hundred multipoles and interpolate
    sparse = np.unique(np.geomspace(ell[0], ell[-1], 200).astype(int))
    power, wave = matter_power(cosmology), (sparse[:, None] + 0.5) / chi
    p = np.stack([power.P(zi, np.minimum(wave[:, k], K_MAX)) for k, zi in enumerate(redshift)], axis=1)
    p *= np.where(wave > K_MAX, (wave / K_MAX) ** -2.5, 1.0)
    values = (p * kernel**2 * step).sum(axis=1)
    return np.exp(np.interp(np.log(ell), np.log(sparse), np.log(values)))


def bin_means(edges: np.ndarray, ell: np.ndarray = ELL) -> tuple[np.ndarray, np.ndarray]:
    """Return the Bessel functions J0 and J4 of ell times separation, averaged over annuli.

    Parameters
    ----------
    edges : ndarray, shape (bins + 1,), radians
        Edges of the bins of separation.
    ell : ndarray, shape (m,)
        Multipoles.

    Returns
    -------
    mean_j0, mean_j4 : ndarray, shape (bins, m)
    """
    x = edges[:, None] * ell
    first = x * j1(x)
    fourth = (x - 8 / x) * j1(x) - 8 * jv(2, x)
    area = (edges[1:] ** 2 - edges[:-1] ** 2)[:, None] / 2 * ell.astype(float) ** 2
    return np.diff(first, axis=0) / area, np.diff(fourth, axis=0) / area


def correlations(edges: np.ndarray, power: np.ndarray, ell: np.ndarray = ELL) -> np.ndarray:
    """Return the two-point functions xi+ and xi- of a power spectrum, averaged over bins of separation.

    Parameters
    ----------
    edges : ndarray, shape (bins + 1,), radians
        Edges of the bins of separation.
    power : ndarray, shape (m,)
        Power spectrum of the convergence at `ell`.
    ell : ndarray, shape (m,)
        Consecutive multipoles.

    Returns
    -------
    ndarray, shape (2, bins)
    """
    weight = ell * power / (2 * np.pi)
    return np.stack([kernel @ weight for kernel in bin_means(edges, ell)])


def covariance(
    edges: np.ndarray,
    power: np.ndarray,
    area: float,
    density: float,
    sigma: float,
    pairs: np.ndarray | None = None,
    ell: np.ndarray = ELL,
) -> np.ndarray:
    """Return the Gaussian covariance of xi+ and xi- of one sample of galaxies.

    It is the sum of sample variance, shape noise and the mixed term (Joachimi et al. 2008, A&A 477, 43).

    Parameters
    ----------
    edges : ndarray, shape (bins + 1,), radians
        Edges of the bins of separation.
    power : ndarray, shape (m,)
        Power spectrum of the convergence at `ell`.
    area : float, steradians
        Area of the survey.
    density : float, galaxies per steradian
    sigma : float
        Rms of one component of the ellipticity.
    pairs : ndarray, shape (bins,), optional
        Number of pairs of galaxies in each bin; computed from area and density, without edge effects, if not given.
    ell : ndarray, shape (m,)
        Consecutive multipoles.

    Returns
    -------
    ndarray, shape (2 * bins, 2 * bins)
        Covariance of xi+ in all bins, followed by xi-.
    """
    noise = sigma**2 / density
    plus, minus = bin_means(edges, ell)
    weight = ell * (power**2 + 2 * power * noise) / (np.pi * area)
    kernels = np.concatenate([plus, minus])
    total = (kernels * weight) @ kernels.T
    if pairs is None:
        pairs = area * density**2 * np.pi * np.diff(edges**2) / 2
    # pure shape noise is equal for xi+ and xi-, and absent between them: of the four products of the components of a
    # pair, two count
    return total + np.diag(np.tile(2 * sigma**4 / pairs, 2))


def signal_to_noise(xi: np.ndarray, matrix: np.ndarray) -> float:
    """Return the signal-to-noise ratio sqrt(xi^T C^-1 xi) of a data vector (n,) with covariance `matrix` (n, n)."""
    return float(np.sqrt(xi @ np.linalg.solve(matrix, xi)))
