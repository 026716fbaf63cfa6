"""Spectra and bandpasses as arrays on a wavelength grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

PLANCK_C = 1.98644586e-16
"""h c in erg cm; with wavelengths in nm the energy of a photon is PLANCK_C / (1e-7 wave) erg."""

NJY_ZERO_POINT = 3.631e12
"""Flux density of AB magnitude 0, nJy."""

MAGNORM_WAVE = 500.0
"""Wavelength, nm, of the rest-frame top-hat that `magnorm` refers to."""


LOG_STEP = 1e-3
"""Step in ln(wavelength) of every spectrum and bandpass: cell j holds wavelengths around exp(j LOG_STEP) nm, so that a
redshift moves a spectrum by one and the same number of cells everywhere."""


def log_grid(low: float, high: float) -> np.ndarray:
    """Return the centres, nm, of the cells from that of `low` to that of `high`, both included."""
    first, last = (int(round(np.log(value) / LOG_STEP)) for value in (low, high))
    return np.exp(np.arange(first, last + 1) * LOG_STEP)


def cell_widths(wave: np.ndarray) -> np.ndarray:
    """Return the widths, nm, of cells with these centres."""
    return wave * 2 * np.sinh(LOG_STEP / 2)


@dataclass(frozen=True)
class Bandpass:
    """A bandpass as means over the cells of the common grid, ready for quadrature."""

    name: str
    wave: np.ndarray
    """(n,) nm, centres of cells of the common grid."""
    throughput: np.ndarray
    """(n,) effective area over `area`, dimensionless."""
    area: float
    """Collecting area, cm2."""
    nodes: np.ndarray
    """(k,) nm: wavelengths at which the PSF is known; between them it is interpolated linearly."""

    @property
    def first(self) -> int:
        """Number of the first cell."""
        return int(round(np.log(self.wave[0]) / LOG_STEP))

    @property
    def weights(self) -> np.ndarray:
        """(n,) cm2 nm: photons per second of a photon density of one per second, cm2 and nm in that cell alone."""
        return self.throughput * cell_widths(self.wave) * self.area

    def node_weights(self) -> np.ndarray:
        """Return (n, k): the share of each cell's photons that goes to each PSF node; rows sum to one."""
        position = np.interp(self.wave, self.nodes, np.arange(len(self.nodes)))
        return np.clip(1 - np.abs(position[:, None] - np.arange(len(self.nodes))), 0, 1)

    def ab_photons(self) -> float:
        """Return the photons a second of a source of AB magnitude 0 (flat f_nu = 3631 Jy)."""
        return float(ab_photon_density(self.wave) @ self.weights)


def ab_photon_density(wave: np.ndarray) -> np.ndarray:
    """Return the photons /s/cm2/nm of AB magnitude 0: f_nu / (h lambda)."""
    planck = 6.62607015e-27  # erg s
    return 3.631e-20 / planck / wave


def ab_magnitude(flux: ArrayLike) -> np.ndarray:
    """Return AB magnitudes of flux densities in nJy; NaN where not positive."""
    flux = np.asarray(flux, float)
    return np.where(flux > 0, 31.4 - 2.5 * np.log10(np.where(flux > 0, flux, 1.0)), np.nan)


@dataclass(frozen=True)
class SpectrumLibrary:
    """Spectra by index, on the common grid, as photon densities relative to that at 500 nm rest frame."""

    names: tuple[str, ...]
    wave: np.ndarray
    """(n,) nm, rest frame, cells of the common grid; beyond either end there is no light."""
    photons: np.ndarray
    """(s, n) photons per nm, 1 at 500 nm."""
    limits: np.ndarray
    """(s, 2) nm: where each spectrum is known."""

    @property
    def first(self) -> int:
        """Number of the first cell."""
        return int(round(np.log(self.wave[0]) / LOG_STEP))


@dataclass(frozen=True)
class LibrarySpectra:
    """Spectra of a table's objects by index into a library; -1 for none."""

    library: SpectrumLibrary
    index: np.ndarray
    """(n,)"""

    def rows(self, chosen: np.ndarray) -> LibrarySpectra:
        """Return the spectra of some of the objects."""
        return LibrarySpectra(self.library, self.index[chosen])


@dataclass(frozen=True)
class TophatSpectra:
    """Top-hat spectra of a table's objects (cosmoDC2).

    Within a bin f_lambda is constant, L_nu times the bin's width in frequency over its width in wavelength, as
    skyCatalogs has it. Beyond the last bin the last value of L_nu is continued (to low redshift the catalog ends short
    of F184's red edge); below the first bin there is no light.
    """

    values: np.ndarray
    """(n, bins) L_nu, any unit; an object without light has zeros."""
    edges: np.ndarray
    """(bins + 1,) nm, rest frame."""

    def rows(self, chosen: np.ndarray) -> TophatSpectra:
        """Return the spectra of some of the objects."""
        return TophatSpectra(self.values[chosen], self.edges)


def library_from(names: list[str], spectra: list[tuple[np.ndarray, np.ndarray]], grid: np.ndarray) -> SpectrumLibrary:
    """Resample spectra (wavelength in nm, f_lambda in any unit) to a library.

    Raises
    ------
    ValueError
        If a spectrum has no light at 500 nm, where `magnorm` is defined.
    """
    rows = np.empty((len(names), len(grid)))
    for row, name, (wave, flambda) in zip(rows, names, spectra, strict=True):
        # between samples the photon density is linear, as GalSim has it; templates are coarse enough for it to matter
        photons = np.asarray(flambda) * wave
        # magnorm is through a top-hat of 1 Angstrom, which matters among the lines of cool stars
        at_500 = np.interp(MAGNORM_WAVE + np.linspace(-0.05, 0.05, 41), wave, photons).mean()
        if not at_500 > 0:
            raise ValueError(f"spectrum {name} has no light at 500 nm, where magnorm is defined")
        row[:] = _cell_means(np.asarray(wave, float), photons, grid) / at_500
    limits = np.array([[wave.min(), wave.max()] for wave, _ in spectra]).reshape(-1, 2)
    return SpectrumLibrary(tuple(names), grid, rows, limits)


def _cell_means(wave: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the means over cells of values that are linear between samples and zero beyond: stars have finer lines."""
    edges = np.concatenate([grid, grid[-1:] * np.exp(LOG_STEP)]) * np.exp(-LOG_STEP / 2)
    nodes = np.union1d(wave, edges)
    at = np.interp(nodes, wave, values, left=0.0, right=0.0)
    total = np.concatenate([[0.0], np.cumsum((at[1:] + at[:-1]) / 2 * np.diff(nodes))])
    return np.diff(total[np.searchsorted(nodes, edges)]) / np.diff(edges)


def default_grid() -> np.ndarray:
    """Return the rest-frame grid of libraries: 60 nm to 2600 nm."""
    return log_grid(60.0, 2600.0)
