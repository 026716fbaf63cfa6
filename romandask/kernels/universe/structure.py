"""The matter of the universe in shells, and what it does: where galaxies are, and how their light is bent.

Lognormal shells on the sphere with the non-linear matter power spectrum (camb), sampled and lensed by glass (Tessore
et al. 2023), so that convergence and shear come from the same matter that galaxies follow.
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
THICKNESS = 200.0
"""Of a shell, comoving Mpc."""
MIN_REDSHIFT = 0.01
LENSED = ("delta", "galaxies", "convergence", "shear_1", "shear_2")
K_MAX = 30.0
"""1/Mpc"""


@dataclass(frozen=True)
class Structure:
    """Fields of every shell in some HEALPix pixels."""

    nside: int
    pixels: np.ndarray
    """(p,) nested, sorted."""
    edges: np.ndarray
    """(s + 1,) redshifts between shells."""
    planes: np.ndarray
    """(s,) redshifts at which the lensing fields hold."""
    fields: dict[str, np.ndarray]
    """(s, p) by name: delta, the matter's contrast; galaxies, the relative density of galaxies (mean 1); convergence;
    shear_1 and shear_2, on-sky sign of GalSim and TreeCorr."""

    def weights(self, ra: np.ndarray, dec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return indices into the pixels and weights (4, n) of bilinear interpolation at positions in degrees."""
        theta, phi = np.radians(90 - np.asarray(dec, float)), np.radians(np.asarray(ra, float))
        pixel, weight = healpy.get_interp_weights(self.nside, theta, phi, nest=True)
        place = np.clip(np.searchsorted(self.pixels, pixel), 0, len(self.pixels) - 1)
        if not (self.pixels[place] == pixel).all():
            raise ValueError("a position lies outside the pixels of the structure")
        return place, weight

    def densities(self, ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
        """Return the relative density of galaxies (positions, shells)."""
        place, weight = self.weights(ra, dec)
        return np.einsum("skn,kn->ns", self.fields["galaxies"][:, place], weight)

    def lensing(
        self, ra: np.ndarray, dec: np.ndarray, redshift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return convergence, shear_1 and shear_2 (n,) at positions and redshifts: linear between planes, 0 here."""
        place, weight = self.weights(ra, dec)
        planes = np.concatenate([[0.0], self.planes])
        upper = np.clip(np.searchsorted(planes, redshift), 1, len(planes) - 1)
        share = np.clip((redshift - planes[upper - 1]) / (planes[upper] - planes[upper - 1]), 0, 1.5)
        found = []
        for name in ("convergence", "shear_1", "shear_2"):
            field = self.fields[name]
            at = [
                np.where(layer >= 0, (field[np.maximum(layer, 0), place] * weight).sum(axis=0), 0.0)
                for layer in (upper - 2, upper - 1)
            ]
            found.append(at[0] * (1 - share) + at[1] * share)
        return found[0], found[1], found[2]


@dataclass(frozen=True)
class Shells:
    """The shells of matter from here to MAX_REDSHIFT."""

    edges: np.ndarray
    """(s + 1,) redshifts."""
    planes: np.ndarray
    """(s,) effective redshifts."""


@lru_cache(maxsize=4)
def shells(cosmology: Cosmology = Cosmology()) -> Shells:  # noqa: B008  a frozen value
    """Return shells about THICKNESS deep."""
    count = int(np.ceil(cosmology.comoving_distance(MAX_REDSHIFT) / THICKNESS))
    edges = glass.distance_grid(cosmology, 0.0, MAX_REDSHIFT, num=count)
    return Shells(np.asarray(edges), np.array([float(window.zeff) for window in _windows(edges, cosmology)]))


def bias(redshift, cosmology: Cosmology = Cosmology()):  # noqa: B008
    """Return the bias of galaxies: 0.95 / D(z) (DESC Science Requirements 2018, appendix D1)."""
    return 0.95 / cosmology.growth(redshift)


@lru_cache(maxsize=4)
def shell_spectra(lmax: int, cosmology: Cosmology = Cosmology()) -> np.ndarray:  # noqa: B008
    """Return the angular power spectra (shells, lmax + 1) of the shells' contrast, each weighted by volume.

    Shells are independent of one another: C_l = int dchi W^2 / chi^2 P((l + 1/2) / chi, z), the thin-shell (Limber)
    limit, good beyond a few times chi / THICKNESS in l: fields of a few degrees lie there.
    """
    power = matter_power(cosmology)
    edges = cosmology.comoving_distance(shells(cosmology).edges)
    ell = np.arange(lmax + 1)
    out = np.zeros((len(edges) - 1, lmax + 1))
    nodes, shares = np.polynomial.legendre.leggauss(24)
    # C_l is smooth: a few hundred values of l and a spline in logs hold it
    sparse = np.unique(np.concatenate([np.arange(1, 64), np.geomspace(64, lmax, 200).astype(int)]))
    for shell, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        chi = (high + low) / 2 + (high - low) / 2 * nodes
        window = 3 * chi**2 / (high**3 - low**3)
        wave = (sparse[:, None] + 0.5) / chi
        z = cosmology.inv_comoving_distance(chi)
        p = np.stack([power.P(zi, np.minimum(wave[:, k], K_MAX)) for k, zi in enumerate(z)], 1)
        # beyond the last wave number of the table the non-linear spectrum falls as k^-2.5
        p *= np.where(wave > K_MAX, (wave / K_MAX) ** -2.5, 1.0)
        values = (p * (window**2 / chi**2 * shares * (high - low) / 2)).sum(axis=1)
        out[shell, 1:] = np.exp(np.interp(np.log(ell[1:]), np.log(sparse), np.log(values)))
    return out


@lru_cache(maxsize=4)
def matter_power(cosmology: Cosmology = Cosmology()):  # noqa: B008
    """Return camb's interpolator of the non-linear matter power spectrum: P(z, k), Mpc^3, k in 1/Mpc."""

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

    first = results(2e-9, np.array([0.0]), 5.0).get_sigma8_0()
    amplitude = 2e-9 * (cosmology.sigma_8 / first) ** 2
    found = results(amplitude, np.linspace(0, MAX_REDSHIFT + 0.1, 32), K_MAX * 1.01)
    return found.get_matter_power_interpolator(nonlinear=True, hubble_units=False, k_hunit=False)


def structure(nside: int, pixels: np.ndarray, seed: int, cosmology: Cosmology = Cosmology()) -> Structure:  # noqa: B008
    """Return the fields of all shells in some pixels of the one sky that belongs to a seed and an nside.

    Parameters
    ----------
    nside : HEALPix resolution of the shells; structure below a pixel is left to groups of galaxies
    pixels : (p,) nested, sorted

    Shells are made and lensed one at a time over the whole sphere: a few maps of 8 bytes a pixel.
    """
    lmax = 2 * nside
    every = shells(cosmology)
    windows = _windows(every.edges, cosmology)
    lens = glass.MultiPlaneConvergence(cosmology)
    ring = healpy.nest2ring(nside, pixels)
    fields = {name: np.zeros((len(windows), len(pixels)), np.float32) for name in LENSED}
    lognormal = glass.grf.Lognormal()
    for shell, (window, spectrum) in enumerate(zip(windows, shell_spectra(lmax, cosmology), strict=True)):
        gaussian = glass.solve_gaussian_spectra([lognormal], [spectrum])
        random = rng(seed, "truth", "structure", nside, shell)
        delta = next(glass.generate([lognormal], gaussian, nside, ncorr=0, rng=random))
        fields["delta"][shell] = delta[ring]
        fields["galaxies"][shell] = _relative_density(delta, float(bias(window.zeff, cosmology)), ring)
        lens.add_window(delta, window)
        fields["convergence"][shell] = lens.kappa[ring]
        fields["shear_1"][shell], fields["shear_2"][shell] = _shear(lens.kappa, nside, lmax, ring)
    return Structure(nside, pixels, every.edges, every.planes, fields)


def bytes_of(nside: int) -> int:
    """Return the peak memory, bytes, of `structure`."""
    return 12 * nside**2 * 8 * 13


def _shear(convergence: np.ndarray, nside: int, lmax: int, ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return shear_1 and shear_2 in some pixels of the shear that belongs to a convergence.

    gamma_lm = -sqrt((l + 2)(l - 1) / (l (l + 1))) kappa_lm. The sphere's axes run south and east, GalSim's west and
    north. (glass's own function would download pixel windows.)
    """
    ell = np.arange(lmax + 1)
    ratio = np.sqrt((ell + 2) * np.maximum(ell - 1, 0) / np.maximum(ell * (ell + 1), 1))
    alm = healpy.almxfl(healpy.map2alm(convergence, lmax=lmax, iter=0), ratio, inplace=True)
    south_east = healpy.alm2map_spin([alm, np.zeros_like(alm)], nside, 2, lmax)
    return -south_east[0][ring], south_east[1][ring]


def _relative_density(delta: np.ndarray, power: float, ring: np.ndarray) -> np.ndarray:
    """(1 + delta)^b over its mean: its correlation is that of the matter to the power b^2, and never negative."""
    grown = np.power(np.maximum(1 + delta, 0), power)
    return (grown[ring] / grown.mean()).astype(np.float32)


def _windows(edges: np.ndarray, cosmology: Cosmology) -> list:
    return glass.tophat_windows(edges, weight=glass.VolumeWeight(cosmology))
