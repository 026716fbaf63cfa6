"""Photon rates of galaxies and stars: magnorm, spectrum, redshift and dust through a bandpass."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import astropy.units as u
import numpy as np
from dust_extinction.parameter_averages import CCM89, F19

from romandask.model.spectra import NJY_ZERO_POINT, Bandpass, ab_photon_density

MIN_RV = 1.0
"""Below this ratio the extinction laws turn negative somewhere and would brighten."""


class Spectra(Protocol):
    """The spectra of a table's objects."""

    def density(self, rows: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Return photon densities, 1 at 500 nm, of some objects at rest-frame wavelengths (rows, samples) in nm."""


def node_photons(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal_av: np.ndarray,
    internal_rv: np.ndarray,
    mw_av: np.ndarray,
    mw_rv: np.ndarray,
    bandpass: Bandpass,
    internal_frame: str = "rest",
    block: int = 4096,
) -> np.ndarray:
    """Return photons per second (objects, nodes) that reach the detector, split among the PSF nodes of the band.

    Parameters
    ----------
    magnorm : (n,) AB magnitude at 500 nm of the rest-frame undusted spectrum; inf or NaN means no light
    spectra : the objects' spectra
    redshift : (n,)
    internal_av, internal_rv : (n,) dust of the galaxy (CCM, in the rest frame unless `internal_frame` is "observed",
        which is what Troxel et al. 2023 did)
    mw_av, mw_rv : (n,) Milky Way dust (F19, observed frame)

    The sum over nodes is the photon rate in the band. Redshift keeps the photon density, GalSim's convention:
    the luminosity distance is in magnorm. Lensing magnification is not included.
    """
    out = np.zeros((len(magnorm), len(bandpass.nodes)))
    weights = bandpass.node_weights() * (bandpass.throughput * bandpass.step * bandpass.area)[:, None]
    lit = np.flatnonzero(np.isfinite(magnorm))
    for start in range(0, len(lit), block):
        rows = lit[start : start + block]
        rest = bandpass.wave / (1 + np.asarray(redshift)[rows, None])
        density = spectra.density(rows, rest)
        frame = rest if internal_frame == "rest" else np.broadcast_to(bandpass.wave, rest.shape)
        density = density * transmission("CCM", frame, internal_av[rows], internal_rv[rows])
        observed = np.broadcast_to(bandpass.wave, rest.shape)
        density = density * transmission("F19", observed, mw_av[rows], mw_rv[rows])
        scale = ab_photon_density(np.array(500.0)) * 10 ** (-0.4 * np.asarray(magnorm)[rows])
        out[rows] = (density @ weights) * scale[:, None]
    return out


def njy(photon_rate: np.ndarray, bandpass: Bandpass) -> np.ndarray:
    """Return AB flux densities, nJy, of photon rates in a band."""
    return np.asarray(photon_rate) * (NJY_ZERO_POINT / bandpass.ab_photons())


def transmission(law: str, wave: np.ndarray, av: np.ndarray, rv: np.ndarray) -> np.ndarray:
    """Return the share of light (objects, samples) that dust lets through at wavelengths in nm.

    `law` is "CCM" (Cardelli, Clayton and Mathis 1989) or "F19" (Fitzpatrick et al. 2019). Beyond the range that a law
    covers its end value holds. Objects without dust (A_V = 0) pass everything whatever their R_V.
    """
    av, rv = np.asarray(av, float), np.asarray(rv, float)
    out = np.ones(wave.shape)
    dusty = np.flatnonzero(av != 0)
    if (rv[dusty] < MIN_RV).any():
        raise ValueError(f"R_V below {MIN_RV} in {int((rv[dusty] < MIN_RV).sum())} objects")
    for value in np.unique(np.round(rv[dusty], 2)):
        rows = dusty[np.round(rv[dusty], 2) == value]
        grid, curve = _curve(law, float(value))
        out[rows] = 10 ** (-0.4 * av[rows, None] * np.interp(1e3 / wave[rows], grid, curve))
    return out


@lru_cache(maxsize=64)
def _curve(law: str, rv: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (x in 1/micron, A(x)/A_V); the laws' own models, tabulated."""
    model = {"CCM": CCM89, "F19": F19}[law]
    low, high = model.Rv_range
    model = model(Rv=min(max(rv, low), high))
    x = np.linspace(model.x_range[0] + 1e-9, model.x_range[1] - 1e-9, 4000)
    return x, np.asarray(model(x / u.micron))
