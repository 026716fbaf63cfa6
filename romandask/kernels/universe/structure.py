"""Large-scale structure in shells of redshift: matter, density of galaxies, convergence and shear.

The matter is a lognormal random field on the sphere in each shell, with the non-linear power spectrum of CAMB. It is
sampled and lensed with GLASS (Tessore et al. 2023), so convergence and shear come from the same matter that the
galaxies trace.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import camb
import glass
import healpy
import numpy as np

from romandask.model.cosmology import Cosmology
from romandask.model.seeds import rng

MAX_REDSHIFT = 3.0
"""Outer edge of the last shell."""
THICKNESS = 200.0
"""Approximate thickness of a shell, comoving Mpc."""
MIN_REDSHIFT = 0.01
"""Smallest redshift of a host galaxy."""
FIELD_NAMES = ("delta", "galaxies", "convergence", "shear_1", "shear_2")
"""Names of the fields of a `Structure`."""
K_MAX = 30.0
"""Largest tabulated wave number of the matter power spectrum, 1/Mpc."""


@dataclass(frozen=True)
class Structure:
    """Fields of s shells in p HEALPix pixels."""

    nside: int
    pixels: np.ndarray
    """Pixel numbers, nested scheme, sorted, shape (p,)."""
    edges: np.ndarray
    """Redshifts of the edges of the shells, shape (s + 1,)."""
    planes: np.ndarray
    """Source redshifts of the convergence and shear of each shell, shape (s,)."""
    fields: dict[str, np.ndarray]
    """Fields by name, shape (s, p).

    delta is the matter density contrast and galaxies the relative density of galaxies (mean 1); convergence, shear_1
    and shear_2 have the on-sky sign convention of GalSim and TreeCorr."""

    def interpolation_weights(self, ra: np.ndarray, dec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices into `pixels` and the weights of bilinear interpolation.

        Parameters
        ----------
        ra, dec : array, shape (n,), degrees
            Positions.

        Returns
        -------
        tuple of arrays, shape (4, n)
            Indices and weights.

        Raises
        ------
        ValueError
            If a position needs a pixel that is not in `pixels`.
        """
        theta, phi = np.radians(90 - np.asarray(dec, float)), np.radians(np.asarray(ra, float))
        pixel, weight = healpy.get_interp_weights(self.nside, theta, phi, nest=True)
        index = np.clip(np.searchsorted(self.pixels, pixel), 0, len(self.pixels) - 1)
        if not (self.pixels[index] == pixel).all():
            raise ValueError("a position lies outside the pixels of the structure")
        return index, weight

    def densities(self, ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
        """Return the relative density of galaxies, shape (n, s), at n positions in degrees."""
        index, weight = self.interpolation_weights(ra, dec)
        return np.einsum("skn,kn->ns", self.fields["galaxies"][:, index], weight)

    def lensing(
        self, ra: np.ndarray, dec: np.ndarray, redshift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return convergence, shear_1 and shear_2 of sources.

        The fields are interpolated linearly in redshift between the planes, from 0 at redshift 0.

        Parameters
        ----------
        ra, dec : array, shape (n,), degrees
            Positions of the sources.
        redshift : array, shape (n,)
            Redshifts of the sources.

        Returns
        -------
        tuple of arrays, shape (n,)
            convergence, shear_1, shear_2.
        """
        index, weight = self.interpolation_weights(ra, dec)
        planes = np.concatenate([[0.0], self.planes])
        upper = np.clip(np.searchsorted(planes, redshift), 1, len(planes) - 1)
        fraction = np.clip((redshift - planes[upper - 1]) / (planes[upper] - planes[upper - 1]), 0, 1.5)
        values = []
        for name in ("convergence", "shear_1", "shear_2"):
            field = self.fields[name]
            at_planes = [
                np.where(plane >= 0, (field[np.maximum(plane, 0), index] * weight).sum(axis=0), 0.0)
                for plane in (upper - 2, upper - 1)
            ]
            values.append(at_planes[0] * (1 - fraction) + at_planes[1] * fraction)
        return values[0], values[1], values[2]


@dataclass(frozen=True)
class Shells:
    """Redshifts of s shells of matter, from 0 to MAX_REDSHIFT."""

    edges: np.ndarray
    """Edges of the shells, shape (s + 1,)."""
    planes: np.ndarray
    """Effective redshifts of the shells, shape (s,)."""


@lru_cache(maxsize=4)
def shells(cosmology: Cosmology = Cosmology()) -> Shells:  # noqa: B008  immutable
    """Return the shells, each about THICKNESS thick."""
    count = int(np.ceil(cosmology.comoving_distance(MAX_REDSHIFT) / THICKNESS))
    edges = glass.distance_grid(cosmology, 0.0, MAX_REDSHIFT, num=count)
    return Shells(np.asarray(edges), np.array([float(window.zeff) for window in _windows(edges, cosmology)]))


def bias(redshift, cosmology: Cosmology = Cosmology()):  # noqa: B008
    """Return the galaxy bias at a redshift, 0.95 / D(z) (DESC Science Requirements 2018, appendix D1)."""
    return 0.95 / cosmology.growth(redshift)


@lru_cache(maxsize=4)
def shell_spectra(lmax: int, cosmology: Cosmology = Cosmology()) -> np.ndarray:  # noqa: B008
    """Return the angular power spectra of the matter density contrast, averaged over the volume of each shell.

    C_l = int dchi W^2 / chi^2 P((l + 1/2) / chi, z), the Limber approximation. It holds for l beyond a few times
    chi / THICKNESS, which includes the scales of fields of a few degrees. Shells are independent of each other.

    Returns
    -------
    array, shape (shells, lmax + 1)
        C_l of each shell.
    """
    power = matter_power(cosmology)
    edges = cosmology.comoving_distance(shells(cosmology).edges)
    ell = np.arange(lmax + 1)
    out = np.zeros((len(edges) - 1, lmax + 1))
    nodes, node_weights = np.polynomial.legendre.leggauss(24)
    # C_l is smooth: it is computed at a few hundred values of l and interpolated linearly in logarithms
    sparse = np.unique(np.concatenate([np.arange(1, 64), np.geomspace(64, lmax, 200).astype(int)]))
    for shell, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        chi = (high + low) / 2 + (high - low) / 2 * nodes
        window = 3 * chi**2 / (high**3 - low**3)
        wave = (sparse[:, None] + 0.5) / chi
        z = cosmology.inv_comoving_distance(chi)
        p = np.stack([power.P(zi, np.minimum(wave[:, k], K_MAX)) for k, zi in enumerate(z)], 1)
        # beyond the last tabulated wave number the non-linear spectrum is continued as k^-2.5
        p *= np.where(wave > K_MAX, (wave / K_MAX) ** -2.5, 1.0)
        values = (p * (window**2 / chi**2 * node_weights * (high - low) / 2)).sum(axis=1)
        out[shell, 1:] = np.exp(np.interp(np.log(ell[1:]), np.log(sparse), np.log(values)))
    return out


@lru_cache(maxsize=4)
def matter_power(cosmology: Cosmology = Cosmology()):  # noqa: B008
    """Return CAMB's interpolator of the non-linear matter power spectrum: P(z, k) in Mpc^3, with k in 1/Mpc."""

    def results(amplitude: float, redshifts: np.ndarray, kmax: float):
        settings = camb.CAMBparams()
        physical = cosmology.h**2
        settings.set_cosmology(
            H0=100 * cosmology.h,
            ombh2=cosmology.omega_b * physical,
            omch2=(cosmology.omega_m - cosmology.omega_b) * physical,
            mnu=0.0,
            num_massive_neutrinos=0,
        )
        settings.InitPower.set_params(ns=cosmology.n_s, As=amplitude)
        settings.set_matter_power(redshifts=sorted(redshifts, reverse=True), kmax=kmax)
        settings.NonLinear = camb.model.NonLinear_pk
        return camb.get_results(settings)

    sigma_8 = results(2e-9, np.array([0.0]), 5.0).get_sigma8_0()
    amplitude = 2e-9 * (cosmology.sigma_8 / sigma_8) ** 2
    scaled = results(amplitude, np.linspace(0, MAX_REDSHIFT + 0.1, 32), K_MAX * 1.01)
    return scaled.get_matter_power_interpolator(nonlinear=True, hubble_units=False, k_hunit=False)


def structure(nside: int, pixels: np.ndarray, seed: int, cosmology: Cosmology = Cosmology()) -> Structure:  # noqa: B008
    """Return the fields of all shells in some pixels.

    The fields depend only on `seed`, `nside` and the cosmology: `pixels` selects a part of the sphere. Shells are made
    and lensed one at a time over the whole sphere, which takes a few maps of 8 bytes per pixel.

    Parameters
    ----------
    nside : int
        HEALPix nside of the shells. Clustering below the pixel scale comes from satellites alone.
    pixels : int array, shape (p,)
        Pixel numbers, nested scheme, sorted.
    seed : int
        Seed of the survey.
    cosmology : Cosmology
        Cosmology.
    """
    lmax = 2 * nside
    all_shells = shells(cosmology)
    windows = _windows(all_shells.edges, cosmology)
    lens = glass.MultiPlaneConvergence(cosmology)
    ring = healpy.nest2ring(nside, pixels)
    fields = {name: np.zeros((len(windows), len(pixels)), np.float32) for name in FIELD_NAMES}
    lognormal = glass.grf.Lognormal()
    for shell, (window, spectrum) in enumerate(zip(windows, shell_spectra(lmax, cosmology), strict=True)):
        gaussian = glass.solve_gaussian_spectra([lognormal], [spectrum])
        random = rng(seed, "truth", "structure", nside, shell)
        delta = next(glass.generate([lognormal], gaussian, nside, ncorr=0, rng=random))
        fields["delta"][shell] = delta[ring]
        fields["galaxies"][shell] = _relative_density(delta, float(bias(window.zeff, cosmology)), ring)
        lens.add_window(delta, window)
        # None only before the first window
        convergence = np.asarray(lens.kappa)
        fields["convergence"][shell] = convergence[ring]
        fields["shear_1"][shell], fields["shear_2"][shell] = _shear(convergence, nside, lmax, ring)
    return Structure(nside, pixels, all_shells.edges, all_shells.planes, fields)


def bytes_of(nside: int) -> int:
    """Return the peak memory of `structure`, bytes."""
    return 12 * nside**2 * 8 * 13


def _shear(convergence: np.ndarray, nside: int, lmax: int, ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shear_1 and shear_2 of a convergence map, in some pixels.

    gamma_lm = -sqrt((l + 2)(l - 1) / (l (l + 1))) kappa_lm. The axes of HEALPix are south and east, those of GalSim
    west and north. The function of GLASS for the same purpose is not used because it downloads pixel windows.

    Parameters
    ----------
    convergence : array, shape (12 nside^2,)
        Convergence, ring scheme.
    nside, lmax : int
        HEALPix nside, and largest multipole.
    ring : int array, shape (p,)
        Pixel numbers, ring scheme.
    """
    ell = np.arange(lmax + 1)
    ratio = np.sqrt((ell + 2) * np.maximum(ell - 1, 0) / np.maximum(ell * (ell + 1), 1))
    alm = healpy.almxfl(healpy.map2alm(convergence, lmax=lmax, iter=0), ratio, inplace=True)
    south_east = healpy.alm2map_spin([alm, np.zeros_like(alm)], nside, 2, lmax)
    return -south_east[0][ring], south_east[1][ring]


def _relative_density(delta: np.ndarray, power: float, ring: np.ndarray) -> np.ndarray:
    """Return (1 + delta)^power over its mean, in some pixels; it is never negative.

    If `delta` is lognormal with correlation function xi, the correlation function of the result is
    (1 + xi)^(power^2) - 1, so `power` is the bias where xi is small.
    """
    biased = np.power(np.maximum(1 + delta, 0), power)
    return (biased[ring] / biased.mean()).astype(np.float32)


def _windows(edges: np.ndarray, cosmology: Cosmology) -> list:
    """Return the window functions of GLASS for shells, weighted by volume."""
    return glass.tophat_windows(edges, weight=glass.VolumeWeight(cosmology))
