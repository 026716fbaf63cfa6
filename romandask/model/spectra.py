"""Spectra and bandpasses as arrays on a wavelength grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PLANCK_C = 1.98644586e-16
"""h c in erg cm; with wavelengths in nm the energy of a photon is PLANCK_C / (1e-7 wave) erg."""

NJY_ZERO_POINT = 3.631e12
"""Flux density of AB magnitude 0, nJy."""

MAGNORM_WAVE = 500.0
"""Wavelength, nm, of the rest-frame top-hat that `magnorm` refers to."""


@dataclass(frozen=True)
class Bandpass:
    """A bandpass sampled at the midpoints of equal steps, ready for quadrature."""

    name: str
    wave: np.ndarray
    """(n,) nm, midpoints."""
    throughput: np.ndarray
    """(n,) effective area over `area`, dimensionless."""
    area: float
    """Collecting area, cm2."""
    nodes: np.ndarray
    """(k,) nm: wavelengths at which the PSF is known; between them it is interpolated linearly."""

    @property
    def step(self) -> float:
        """Width of a sample, nm."""
        return float(self.wave[1] - self.wave[0])

    def node_weights(self) -> np.ndarray:
        """Return (n, k): the share of each sample's photons that goes to each PSF node; rows sum to one."""
        position = np.interp(self.wave, self.nodes, np.arange(len(self.nodes)))
        return np.clip(1 - np.abs(position[:, None] - np.arange(len(self.nodes))), 0, 1)

    def ab_photons(self) -> float:
        """Return the photons a second of a source of AB magnitude 0 (flat f_nu = 3631 Jy)."""
        return float((ab_photon_density(self.wave) * self.throughput).sum() * self.step * self.area)


def ab_photon_density(wave: np.ndarray) -> np.ndarray:
    """Return the photons /s/cm2/nm of AB magnitude 0: f_nu / (h lambda)."""
    planck = 6.62607015e-27  # erg s
    return 3.631e-20 / planck / wave


@dataclass(frozen=True)
class SpectrumLibrary:
    """Spectra by index, on one wavelength grid, as photon densities relative to that at 500 nm rest frame."""

    names: tuple[str, ...]
    wave: np.ndarray
    """(n,) nm, rest frame, equally spaced in log."""
    photons: np.ndarray
    """(s, n) photons per nm, 1 at 500 nm."""

    def evaluate(self, index: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Return photon densities (objects, samples) of spectra `index` at rest-frame wavelengths `wave`.

        Beyond either end of the grid the spectrum is zero.
        """
        log0, step = np.log(self.wave[0]), np.log(self.wave[1] / self.wave[0])
        position = (np.log(wave) - log0) / step
        low = np.clip(position.astype(np.int64), 0, len(self.wave) - 2)
        share = position - low
        rows = np.asarray(index)[:, None]
        if rows.size and rows.min() < 0:
            raise ValueError("an object without a spectrum cannot have light")
        value = self.photons[rows, low] * (1 - share) + self.photons[rows, low + 1] * share
        return np.where((position >= 0) & (position <= len(self.wave) - 1), value, 0.0)


@dataclass(frozen=True)
class LibrarySpectra:
    """Spectra of a table's objects by index into a library; -1 for none."""

    library: SpectrumLibrary
    index: np.ndarray
    """(n,)"""

    def density(self, rows: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Return photon densities (rows, samples), 1 at 500 nm, at rest-frame wavelengths in nm."""
        return self.library.evaluate(self.index[rows], wave)


@dataclass(frozen=True)
class TophatSpectra:
    """Top-hat spectra of a table's objects (cosmoDC2)."""

    values: np.ndarray
    """(n, bins) L_nu, any unit."""
    edges: np.ndarray
    """(bins + 1,) nm."""

    def density(self, rows: np.ndarray, wave: np.ndarray) -> np.ndarray:
        """Return photon densities (rows, samples), 1 at 500 nm, at rest-frame wavelengths in nm."""
        return tophat_photons(self.values[rows], self.edges, wave)


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
        at_500 = np.interp(MAGNORM_WAVE, wave, photons)
        if not at_500 > 0:
            raise ValueError(f"spectrum {name} has no light at 500 nm, where magnorm is defined")
        row[:] = np.interp(grid, wave, photons, left=0.0, right=0.0) / at_500
    return SpectrumLibrary(tuple(names), grid, rows)


def default_grid() -> np.ndarray:
    """Return the rest-frame grid of libraries: 60 nm to 2600 nm in steps of 0.1 per cent."""
    return np.exp(np.arange(np.log(60.0), np.log(2600.0), 1e-3))


def tophat_photons(values: np.ndarray, edges: np.ndarray, wave: np.ndarray) -> np.ndarray:
    """Return photon densities (objects, samples), 1 at 500 nm, of top-hat spectra (cosmoDC2).

    Parameters
    ----------
    values : (objects, bins) luminosity L_nu per bin, any unit; an object without light has zeros
    edges : (bins + 1,) nm, rest frame
    wave : (objects, samples) nm, rest frame

    Within a bin f_lambda is constant, L_nu times the bin's width in frequency over its width in wavelength, as
    skyCatalogs has it. Beyond the last bin the last value of L_nu is continued (to low redshift the catalog
    ends short of F184's red edge); below the first bin there is no light.
    """
    inverse = 1 / edges
    flambda = values * (inverse[:-1] - inverse[1:]) / (edges[1:] - edges[:-1])
    reference = np.searchsorted(edges, MAGNORM_WAVE, side="right") - 1
    norm = np.where(values[:, reference] > 0, values[:, reference] / MAGNORM_WAVE**2, 1.0)
    bins = np.searchsorted(edges, wave, side="right") - 1
    inside = np.take_along_axis(flambda, np.clip(bins, 0, len(edges) - 2), axis=1)
    beyond = values[:, -1:] / wave**2
    density = np.where(bins > len(edges) - 2, beyond, np.where(bins < 0, 0.0, inside))
    return density / norm[:, None] * wave / MAGNORM_WAVE
