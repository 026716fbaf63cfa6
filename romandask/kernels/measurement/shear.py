"""Cosmic shear: shapes of galaxies, the power spectrum of the convergence, its two-point functions, their covariance.

Flat sky. Bins of separation are averaged over exactly, in the theory and in the covariance (Joachimi et al. 2021, A&A
646, A129, appendix A): a bin's Bessel function is its mean over the annulus.
"""

from __future__ import annotations

import numpy as np
from scipy.special import j1, jv

from romandask.kernels.universe.structure import K_MAX, matter_power
from romandask.model.cosmology import SPEED_OF_LIGHT, Cosmology

ELL = np.arange(2, 60_001)
"""Multipoles that are summed: to a twentieth of the smallest separation in use."""


def shapes(
    major: np.ndarray, minor: np.ndarray, angle: np.ndarray, shear1: np.ndarray, shear2: np.ndarray, kappa: np.ndarray
) -> np.ndarray:
    """Return lensed ellipticities (n,), complex, (a - b) / (a + b) in GalSim's and TreeCorr's on-sky components.

    Parameters
    ----------
    major, minor, angle : semi-axes before lensing and position angle of the major one, degrees east of north
    shear1, shear2, kappa : shear and convergence: the reduced shear acts (Seitz & Schneider 1997)
    """
    # components are those of an angle from west through north
    own = (major - minor) / (major + minor) * np.exp(2j * np.radians(90.0 + np.asarray(angle, float)))
    reduced = (np.asarray(shear1) + 1j * np.asarray(shear2)) / (1 - np.asarray(kappa))
    return (own + reduced) / (1 + np.conj(reduced) * own)


def convergence_power(
    edges: np.ndarray,
    counts: np.ndarray,
    ell: np.ndarray = ELL,
    cosmology: Cosmology = Cosmology(),  # noqa: B008
) -> np.ndarray:
    """Return the power spectrum of the convergence (len(ell),) of sources with `counts` between redshift `edges`.

    Limber's approximation, with camb's non-linear spectrum.
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
    # smooth in the logarithm: a few hundred multipoles hold it
    sparse = np.unique(np.geomspace(ell[0], ell[-1], 200).astype(int))
    power, wave = matter_power(cosmology), (sparse[:, None] + 0.5) / chi
    p = np.stack([power.P(zi, np.minimum(wave[:, k], K_MAX)) for k, zi in enumerate(redshift)], axis=1)
    p *= np.where(wave > K_MAX, (wave / K_MAX) ** -2.5, 1.0)
    values = (p * kernel**2 * step).sum(axis=1)
    return np.exp(np.interp(np.log(ell), np.log(sparse), np.log(values)))


def bin_means(edges: np.ndarray, ell: np.ndarray = ELL) -> tuple[np.ndarray, np.ndarray]:
    """Return J0 and J4 (bins, len(ell)), averaged over annuli between `edges` (radians)."""
    x = edges[:, None] * ell
    first = x * j1(x)
    fourth = (x - 8 / x) * j1(x) - 8 * jv(2, x)
    area = (edges[1:] ** 2 - edges[:-1] ** 2)[:, None] / 2 * ell.astype(float) ** 2
    return np.diff(first, axis=0) / area, np.diff(fourth, axis=0) / area


def correlations(edges: np.ndarray, power: np.ndarray, ell: np.ndarray = ELL) -> np.ndarray:
    """Return xi+ and xi- (2, bins) of a power spectrum, averaged over bins of separation (radians)."""
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
    """Return the Gaussian covariance (2 bins, 2 bins) of xi+ and then xi-, of one sample of galaxies.

    Sample variance, shape noise, and their product (Joachimi et al. 2008, A&A 477, 43).

    Parameters
    ----------
    edges : of the bins of separation, radians
    power : of the convergence, at `ell`
    area : steradians
    density : galaxies a steradian
    sigma : rms of one component of the ellipticity
    pairs : (bins,) pairs of galaxies that were counted; those of the area without its edges if not given
    """
    noise = sigma**2 / density
    plus, minus = bin_means(edges, ell)
    weight = ell * (power**2 + 2 * power * noise) / (np.pi * area)
    kernels = np.concatenate([plus, minus])
    total = (kernels * weight) @ kernels.T
    if pairs is None:
        pairs = area * density**2 * np.pi * np.diff(edges**2) / 2
    # shape noise alone: of xi+ and of xi- alike, and none between them; a pair has four products, two of which count
    return total + np.diag(np.tile(2 * sigma**4 / pairs, 2))


def signal_to_noise(xi: np.ndarray, matrix: np.ndarray) -> float:
    """Return sqrt(xi^T C^-1 xi)."""
    return float(np.sqrt(xi @ np.linalg.solve(matrix, xi)))
