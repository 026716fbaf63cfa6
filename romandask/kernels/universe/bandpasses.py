"""Bandpasses from the data files of GalSim, averaged over cells of the common wavelength grid."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import galsim
import galsim.roman
import numpy as np

from romandask.model.spectra import LOG_STEP, Bandpass, cell_widths, log_grid

SUBSAMPLES = 32
"""Number of samples per cell of the common grid, over which the throughput is averaged; filters have steep edges."""


@lru_cache(maxsize=64)
def roman_bandpass(band: str, n_waves: int) -> Bandpass:
    """Return a Roman bandpass with `n_waves` PSF nodes.

    The throughput is the effective area over galsim.roman.collecting_area.
    """
    return sampled(band, galsim_roman_bandpasses()[band], galsim.roman.collecting_area, n_waves)


@lru_cache(maxsize=1)
def galsim_roman_bandpasses() -> dict[str, galsim.Bandpass]:
    """Return GalSim's Roman bandpasses by name, with AB zero points."""
    return galsim.roman.getBandpasses(AB_zeropoint=True)


@lru_cache(maxsize=64)
def rubin_bandpass(band: str, n_waves: int, area: float) -> Bandpass:
    """Return an LSST bandpass with `n_waves` PSF nodes, for a collecting area in cm2.

    The throughput is that of atmosphere, mirrors, lenses, filter and detector.
    """
    path = Path(galsim.meta_data.share_dir) / "bandpasses" / f"LSST_{band}.dat"
    return sampled(band, galsim.Bandpass(str(path), "nm"), area, n_waves)


def sampled(name: str, bandpass: galsim.Bandpass, area: float, n_waves: int) -> Bandpass:
    """Return a bandpass averaged over cells of the common grid.

    Parameters
    ----------
    name : str
        Name of the band.
    bandpass : galsim.Bandpass
        Throughput.
    area : float, cm2
        Collecting area.
    n_waves : int
        Number of PSF nodes, equally spaced between the wavelengths at which the throughput is 1e-3 of its peak.
    """
    wave = log_grid(bandpass.blue_limit, bandpass.red_limit)
    widths = cell_widths(wave)
    fine = wave[:, None] * np.exp(LOG_STEP * ((np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5))
    inside = (fine >= bandpass.blue_limit) & (fine <= bandpass.red_limit)
    throughput = np.where(inside, bandpass(np.clip(fine, bandpass.blue_limit, bandpass.red_limit)), 0.0)
    steps = fine * LOG_STEP / SUBSAMPLES
    # the tails below a thousandth of the peak are kept in the throughput, but would only spread the nodes
    trimmed = bandpass.truncate(relative_throughput=1e-3)
    nodes = np.linspace(trimmed.blue_limit, trimmed.red_limit, n_waves)
    return Bandpass(
        name=name,
        wave=wave,
        throughput=(throughput * steps).sum(axis=1) / widths,
        area=area,
        nodes=nodes,
    )
