"""Photon rates of galaxies and stars: magnorm, spectrum, redshift and dust through bandpasses, compiled.

Spectra, bandpasses and dust laws live on one grid in ln(wavelength). A redshift moves a spectrum by a whole number of
cells and a fraction that is the same everywhere, so an object costs one pass over the cells that any band covers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import astropy.units as u
import numpy as np
from dust_extinction.parameter_averages import CCM89, F19
from numba import njit

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

MIN_RV = 1.0
"""Below this ratio the extinction laws turn negative somewhere and would brighten."""
LAWS = {"CCM": CCM89, "F19": F19}
"""Cardelli, Clayton and Mathis 1989; Fitzpatrick et al. 2019."""
SEEN, NO_MILKY_WAY, CLEAR = range(3)
"""First axis of rates: with all dust, with the galaxy's own alone, with none."""
_TO_TAU = 0.4 * np.log(10.0)

Spectra = LibrarySpectra | TophatSpectra


@dataclass(frozen=True)
class Dust:
    """Dust before each object."""

    av: np.ndarray
    """(n,) A_V, mag; 0 for none."""
    rv: np.ndarray
    """(n,) A_V / E(B-V)."""


def no_dust(n: int) -> Dust:
    """Return clear sky for n objects."""
    return Dust(np.zeros(n), np.full(n, 3.1))


def node_photons(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal: Dust,
    milky_way: Dust,
    bandpass: Bandpass,
    internal_frame: str = "rest",
) -> np.ndarray:
    """Return photons per second (objects, nodes) that reach the detector, split among the PSF nodes of the band.

    Parameters
    ----------
    magnorm : (n,) AB magnitude at 500 nm of the rest-frame undusted spectrum; inf or NaN means no light
    spectra : the objects' spectra
    redshift : (n,)
    internal : dust of the galaxy (CCM, in the rest frame unless `internal_frame` is "observed", which is what Troxel
        et al. 2023 did)
    milky_way : F19, in the observed frame

    The sum over nodes is the photon rate in the band. Redshift keeps the photon density, GalSim's convention:
    the luminosity distance is in magnorm. Lensing magnification is not included.
    """
    shares = bandpass.node_weights() * bandpass.weights[:, None]
    rows = [(bandpass.first + used[0], shares[used[0] : used[-1] + 1, k]) for k, used in _used(shares)]
    return _rates(magnorm, spectra, redshift, internal, milky_way, _channels(rows), internal_frame)[SEEN]


def band_photons(
    magnorm: np.ndarray,
    spectra: Spectra,
    redshift: np.ndarray,
    internal: Dust,
    milky_way: Dust,
    bandpasses: tuple[Bandpass, ...],
    internal_frame: str = "rest",
) -> np.ndarray:
    """Return photons per second (3, objects, bands): as `node_photons`, without the Milky Way's dust, without any."""
    channels = _channels([(bandpass.first, bandpass.weights) for bandpass in bandpasses])
    return _rates(magnorm, spectra, redshift, internal, milky_way, channels, internal_frame)


def njy(photon_rate: np.ndarray, bandpass: Bandpass) -> np.ndarray:
    """Return AB flux densities, nJy, of photon rates in a band."""
    return np.asarray(photon_rate) * (NJY_ZERO_POINT / bandpass.ab_photons())


def transmission(law: str, wave: np.ndarray, av: float, rv: float) -> np.ndarray:
    """Return the share of light that dust lets through at wavelengths in nm; `law` is "CCM" or "F19"."""
    a, b, rv = *_curve(law, np.asarray(wave, float)), _bounded(law, np.array([rv]))[0]
    return 10 ** (-0.4 * av * (a + b / rv))


def extinction(bandpass: Bandpass, milky_way: Dust) -> np.ndarray:
    """Return by how many magnitudes (n,) the Milky Way's dust (F19) dims a source of flat f_nu in a band."""
    av, ev = _columns(milky_way, "F19")
    a, b = _curve("F19", bandpass.wave)
    light = ab_photon_density(bandpass.wave) * bandpass.weights
    out = np.zeros(len(av))
    # some objects at a time: each has the whole band's wavelengths
    for first in range(0, len(av), 8192):
        rows = slice(first, first + 8192)
        left = np.exp(-_TO_TAU * (av[rows, None] * a + ev[rows, None] * b))
        out[rows] = -2.5 * np.log10(left @ light / light.sum())
    return out


@dataclass(frozen=True)
class _Channels:
    """Weighted sums over cells: a band, or the share of a band that goes to one PSF node."""

    first: int
    """Number of the first cell that any channel covers."""
    cells: int
    starts: np.ndarray
    """(channels,) first cell of each, from `first`."""
    offsets: np.ndarray
    """(channels + 1,) where the weights of each begin."""
    weights: np.ndarray

    @property
    def wave(self) -> np.ndarray:
        """(cells,) centres, nm."""
        return np.exp((self.first + np.arange(self.cells)) * LOG_STEP)


def _used(shares: np.ndarray) -> list[tuple[int, np.ndarray]]:
    return [(k, np.flatnonzero(shares[:, k] > 0)) for k in range(shares.shape[1])]


def _channels(rows: list[tuple[int, np.ndarray]]) -> _Channels:
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
) -> np.ndarray:
    magnorm = np.asarray(magnorm, float)
    n = len(magnorm)
    lit = np.isfinite(magnorm)
    scale = np.where(lit, ab_photon_density(np.array(MAGNORM_WAVE)) * 10 ** (-0.4 * np.where(lit, magnorm, 0.0)), 0.0)
    shift = np.log1p(np.asarray(redshift, float)) / LOG_STEP
    rest = internal_frame == "rest"
    # the galaxy's own dust is tabulated where its light was emitted, or where it is seen
    dust_first = default_first() if rest else channels.first
    dust_wave = _rest_wave() if rest else channels.wave
    outside = _columns(milky_way, "F19")
    inside = _columns(internal, "CCM")
    out = np.zeros((3, n, len(channels.starts)))
    common = (
        scale,
        shift,
        channels.first,
        channels.cells,
        *inside,
        *_curve("CCM", dust_wave),
        dust_first,
        rest,
        *outside,
        *_curve("F19", channels.wave),
        channels.starts,
        channels.offsets,
        channels.weights,
        out,
    )
    if isinstance(spectra, LibrarySpectra):
        index = np.asarray(spectra.index, np.int64)
        if n and (index[lit] < 0).any():
            raise ValueError("an object without a spectrum cannot have light")
        _library_rates(spectra.library.photons, spectra.library.first, index, *common)
    else:
        values, edges = np.asarray(spectra.values, float), np.asarray(spectra.edges, float)
        widths = (1 / edges[:-1] - 1 / edges[1:]) / np.diff(edges)
        at_500 = values[:, np.searchsorted(edges, MAGNORM_WAVE, side="right") - 1]
        norm = np.where(at_500 > 0, at_500 / MAGNORM_WAVE**2, 1.0) * MAGNORM_WAVE
        _tophat_rates(values * widths / norm[:, None], values[:, -1] / norm, edges, *common)
    return out


def _columns(dust: Dust, law: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (A_V, A_V / R_V), zero where there is no dust, whatever R_V is there."""
    av = np.asarray(dust.av, float)
    rv = np.where(av != 0, np.asarray(dust.rv, float), 3.1)
    if (~(rv >= MIN_RV)).any():
        raise ValueError(f"R_V below {MIN_RV} in {int((~(rv >= MIN_RV)).sum())} objects")
    return av, av / _bounded(law, rv)


def _bounded(law: str, rv: np.ndarray) -> np.ndarray:
    """R_V within the range of the law."""
    return np.clip(rv, *LAWS[law].Rv_range)


def _curve(law: str, wave: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b of A(lambda) / A_V = a + b / R_V, the form of both laws; beyond its range the end holds."""
    model = LAWS[law]
    x = np.clip(1e3 / wave, model.x_range[0] + 1e-9, model.x_range[1] - 1e-9)
    low, high = (np.asarray(model(Rv=value)(x / u.micron)) for value in (2.5, 5.0))
    slope = (low - high) / (1 / 2.5 - 1 / 5.0)
    return low - slope / 2.5, slope


@lru_cache(maxsize=1)
def _rest_wave() -> np.ndarray:
    return log_grid(20.0, 2600.0)


def default_first() -> int:
    """Return the number of the first cell on which rest-frame dust is tabulated."""
    return int(round(np.log(_rest_wave()[0]) / LOG_STEP))


@njit(cache=True, nogil=True, error_model="numpy")
def after(tau):
    """Return exp(-tau), to six digits wherever light is left: a series of a 64th of it, squared six times.

    It calls nothing, so that loops around it are vectorised.
    """
    x = max(-tau, -60.0) / 64
    e = 1 + x * (1 + x * (0.5 + x * (1 / 6 + x * (1 / 24 + x / 120))))
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e


@njit(cache=True, nogil=True, error_model="numpy")
def _fade(work, lo, hi, av, ev, a, b, base, share):
    """Multiply cells lo to hi by exp(-tau) of a dust law, tabulated from `base` on, `share` of a cell further."""
    for j in range(lo, hi):
        k = base + j
        tau = av * (a[k] * (1 - share) + a[k + 1] * share) + ev * (b[k] * (1 - share) + b[k + 1] * share)
        work[j] *= after(tau * _TO_TAU)


@njit(cache=True, nogil=True, error_model="numpy")
def _sums(work, scale, starts, offsets, weights, out):
    for c in range(len(starts)):
        total = 0.0
        for k in range(offsets[c], offsets[c + 1]):
            total += work[starts[c] + k - offsets[c]] * weights[k]
        out[c] = total * scale


@njit(cache=True, nogil=True, error_model="numpy")
def _through_dust(
    i,
    work,
    lo,
    hi,
    shift,
    first,
    in_av,
    in_ev,
    in_a,
    in_b,
    in_first,
    rest,
    mw_av,
    mw_ev,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    scale,
    out,
):
    """Apply both dusts to the photon densities `work` of one object and write its sums."""
    _sums(work, scale[i], starts, offsets, weights, out[CLEAR, i])
    if in_av[i] != 0:
        whole = np.floor(-shift[i]) if rest else 0.0
        share = -shift[i] - whole if rest else 0.0
        base = first - in_first + int(whole)
        begin = max(lo, -base)
        end = min(hi, len(in_a) - 1 - base) if rest else hi - 1
        _fade(work, begin, end, in_av[i], in_ev[i], in_a, in_b, base, share)
        if not rest:
            work[hi - 1] *= np.exp(-_TO_TAU * (in_av[i] * in_a[base + hi - 1] + in_ev[i] * in_b[base + hi - 1]))
    _sums(work, scale[i], starts, offsets, weights, out[NO_MILKY_WAY, i])
    if mw_av[i] != 0:
        _fade(work, lo, hi - 1, mw_av[i], mw_ev[i], mw_a, mw_b, 0, 0.0)
        work[hi - 1] *= np.exp(-_TO_TAU * (mw_av[i] * mw_a[hi - 1] + mw_ev[i] * mw_b[hi - 1]))
        _sums(work, scale[i], starts, offsets, weights, out[SEEN, i])
    else:
        out[SEEN, i] = out[NO_MILKY_WAY, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _library_rates(
    photons,
    photons_first,
    index,
    scale,
    shift,
    first,
    cells,
    in_av,
    in_ev,
    in_a,
    in_b,
    in_first,
    rest,
    mw_av,
    mw_ev,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    out,
):
    work = np.empty(cells)
    for i in range(len(scale)):
        if scale[i] == 0:
            continue
        whole = np.floor(-shift[i])
        share = -shift[i] - whole
        base = first - photons_first + int(whole)
        row = photons[index[i]]
        lo, hi = min(max(0, -base), cells), max(0, min(cells, len(row) - 1 - base))
        work[:lo] = 0.0
        work[hi:] = 0.0
        for j in range(lo, hi):
            work[j] = row[base + j] * (1 - share) + row[base + j + 1] * share
        _through_dust(
            i,
            work,
            0,
            cells,
            shift,
            first,
            in_av,
            in_ev,
            in_a,
            in_b,
            in_first,
            rest,
            mw_av,
            mw_ev,
            mw_a,
            mw_b,
            starts,
            offsets,
            weights,
            scale,
            out,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _tophat_rates(
    flambda,
    beyond,
    edges,
    scale,
    shift,
    first,
    cells,
    in_av,
    in_ev,
    in_a,
    in_b,
    in_first,
    rest,
    mw_av,
    mw_ev,
    mw_a,
    mw_b,
    starts,
    offsets,
    weights,
    out,
):
    """Cell means of photon density flambda(bin) * lambda, and beyond / lambda behind the last bin."""
    work = np.empty(cells)
    bins = len(edges) - 1
    half = np.exp(LOG_STEP / 2)
    for i in range(len(scale)):
        if scale[i] == 0:
            continue
        at = -1
        for j in range(cells):
            middle = np.exp((first + j - shift[i]) * LOG_STEP)
            low, high = middle / half, middle * half
            while at < bins and edges[at + 1] <= low:
                at += 1
            total, start, k = 0.0, low, at
            while start < high:
                stop = min(high, edges[k + 1]) if k < bins else high
                if k >= bins:
                    total += beyond[i] * np.log(stop / start)
                elif k >= 0:
                    total += flambda[i, k] * (stop * stop - start * start) / 2
                start = stop
                k += 1
            work[j] = total / (high - low)
        _through_dust(
            i,
            work,
            0,
            cells,
            shift,
            first,
            in_av,
            in_ev,
            in_a,
            in_b,
            in_first,
            rest,
            mw_av,
            mw_ev,
            mw_a,
            mw_b,
            starts,
            offsets,
            weights,
            scale,
            out,
        )
