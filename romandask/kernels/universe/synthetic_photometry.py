"""Synthetic photometry: photon rates of galaxies and stars from magnorm, spectrum, redshift and dust.

Spectra, bandpasses and extinction curves live on one grid in ln(wavelength). A redshift shifts a spectrum by the same
number of cells at all wavelengths, so an object costs one pass over the cells that any band covers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from romandask.kernels.universe.dust import ALL_DUST, INTERNAL_DUST, NO_DUST, Dust, av_and_ebv, extinction_curve
from romandask.kernels.universe.photon_integrals import library_rates, tophat_rates
from romandask.model.spectra import (
    LOG_STEP,
    MAGNORM_WAVE,
    NJY_ZERO_POINT,
    Bandpass,
    LibrarySpectra,
    TophatSpectra,
    ab_photon_density,
    log_grid,
)

Spectra = LibrarySpectra | TophatSpectra


def node_photons(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal: Dust,
    milky_way: Dust,
    bandpass: Bandpass,
    internal_frame: str = "rest",
) -> np.ndarray:
    """Return the photon rates of n objects in a band, divided among the PSF nodes of the band.

    A redshift keeps the photon density, as in GalSim: the luminosity distance is part of magnorm. Lensing magnification
    is not included.

    Parameters
    ----------
    magnorm : array, shape (n,), mag
        AB magnitude at 500 nm of the rest-frame spectrum without dust; inf or NaN for an object without light.
    spectra : LibrarySpectra or TophatSpectra
        Spectra of the objects.
    redshift : array, shape (n,)
        Redshifts.
    internal : Dust
        Dust of the galaxies, with the CCM law.
    milky_way : Dust
        Dust of the Milky Way, with the F19 law in the observed frame.
    bandpass : Bandpass
        Band.
    internal_frame : {"rest", "observed"}
        Frame in which the dust of the galaxies acts; "observed" reproduces Troxel et al. (2023).

    Returns
    -------
    array, shape (n, nodes), photons/s
        Photon rates at the detector; the sum over the nodes is the photon rate in the band.
    """
    shares = bandpass.node_weights() * bandpass.weights[:, None]
    nodes = [(k, np.flatnonzero(shares[:, k] > 0)) for k in range(shares.shape[1])]
    rows = [(bandpass.first + used[0], shares[used[0] : used[-1] + 1, k]) for k, used in nodes]
    channels = _channels(rows)
    return _rates(magnorm, spectra, redshift, internal, milky_way, channels, internal_frame, (ALL_DUST,))[0]


def band_photons(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal: Dust,
    milky_way: Dust,
    bandpasses: tuple[Bandpass, ...],
    internal_frame: str = "rest",
) -> np.ndarray:
    """Return the photon rates of n objects in several bands, with and without dust.

    Parameters
    ----------
    magnorm, spectra, redshift, internal, milky_way, internal_frame
        As for `node_photons`.
    bandpasses : tuple of Bandpass
        Bands.

    Returns
    -------
    array, shape (3, n, bands), photons/s
        Photon rates. The first axis is ALL_DUST, INTERNAL_DUST (without that of the Milky Way), NO_DUST.
    """
    channels = _channels([(bandpass.first, bandpass.weights) for bandpass in bandpasses])
    return _rates(magnorm, spectra, redshift, internal, milky_way, channels, internal_frame)


def njy(photon_rate: np.ndarray, bandpass: Bandpass) -> np.ndarray:
    """Return the AB flux densities, nJy, of photon rates in a band."""
    return np.asarray(photon_rate) * (NJY_ZERO_POINT / bandpass.ab_photons())


@dataclass(frozen=True)
class _Channels:
    """Weighted sums over cells; a channel is a band, or the part of a band assigned to one PSF node."""

    first: int
    """Index on the common grid of the first cell that any channel covers."""
    cells: int
    """Number of cells from there to the last cell that any channel covers."""
    starts: np.ndarray
    """First cell of each channel, counted from `first`, shape (channels,)."""
    offsets: np.ndarray
    """Index into `weights` of the first weight of each channel, shape (channels + 1,)."""
    weights: np.ndarray
    """Weights of the cells of all channels, one channel after the other, cm2 nm."""

    @property
    def wave(self) -> np.ndarray:
        """Centres of the cells, shape (cells,), nm."""
        return np.exp((self.first + np.arange(self.cells)) * LOG_STEP)


def _channels(rows: list[tuple[int, np.ndarray]]) -> _Channels:
    """Return the channels whose first cells on the common grid, and weights, are given."""
    first = min(start for start, _ in rows)
    last = max(start + len(weights) for start, weights in rows)
    offsets = np.concatenate([[0], np.cumsum([len(weights) for _, weights in rows])])
    starts = np.array([start - first for start, _ in rows])
    return _Channels(first, last - first, starts, offsets, np.concatenate([weights for _, weights in rows]))


def _rates(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal: Dust,
    milky_way: Dust,
    channels: _Channels,
    internal_frame: str,
    dust: tuple[int, ...] = (ALL_DUST, INTERNAL_DUST, NO_DUST),
) -> np.ndarray:
    """Return the photon rates, shape (dust, n, channels), of `band_photons`, for every `dust` or ALL_DUST alone."""
    magnorm = np.asarray(magnorm, float)
    n = len(magnorm)
    lit = np.isfinite(magnorm)
    scale = np.where(lit, ab_photon_density(np.array(MAGNORM_WAVE)) * 10 ** (-0.4 * np.where(lit, magnorm, 0.0)), 0.0)
    shift = np.log1p(np.asarray(redshift, float)) / LOG_STEP
    rest_frame = internal_frame == "rest"
    # the extinction curve of the internal dust is tabulated in the frame in which the dust acts
    internal_first = _rest_frame_first_cell() if rest_frame else channels.first
    internal_wave = _rest_frame_wave() if rest_frame else channels.wave
    milky_way_av_ebv = av_and_ebv(milky_way, "F19")
    internal_av_ebv = av_and_ebv(internal, "CCM")
    out = np.zeros((len(dust), n, len(channels.starts)))
    common = (
        scale,
        shift,
        channels.first,
        channels.cells,
        *internal_av_ebv,
        *extinction_curve("CCM", internal_wave),
        internal_first,
        rest_frame,
        *milky_way_av_ebv,
        *extinction_curve("F19", channels.wave),
        channels.starts,
        channels.offsets,
        channels.weights,
        out,
    )
    if isinstance(spectra, LibrarySpectra):
        index = np.asarray(spectra.index, np.int64)
        if n and (index[lit] < 0).any():
            raise ValueError("an object without a spectrum cannot have light")
        library_rates(spectra.library.photons, spectra.library.first, index, *common)
    else:
        values, edges = np.asarray(spectra.values, float), np.asarray(spectra.edges, float)
        widths = (1 / edges[:-1] - 1 / edges[1:]) / np.diff(edges)
        at_500 = values[:, np.searchsorted(edges, MAGNORM_WAVE, side="right") - 1]
        norm = np.where(at_500 > 0, at_500 / MAGNORM_WAVE**2, 1.0) * MAGNORM_WAVE
        tophat_rates(values * widths / norm[:, None], values[:, -1] / norm, edges, *common)
    return out


@lru_cache(maxsize=1)
def _rest_frame_wave() -> np.ndarray:
    """Return the wavelengths, nm, at which extinction curves are tabulated in the rest frame."""
    return log_grid(20.0, 2600.0)


def _rest_frame_first_cell() -> int:
    """Return the index on the common grid of the first cell of the rest-frame wavelengths."""
    return int(round(np.log(_rest_frame_wave()[0]) / LOG_STEP))
