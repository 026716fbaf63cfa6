"""Bandpasses from GalSim's share folder (no download), sampled for quadrature."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import galsim
import galsim.roman
import numpy as np

from romandask.model.spectra import LOG_STEP, Bandpass, cell_widths, log_grid

SUBSAMPLES = 32
"""Points a cell of the common grid: bandpasses are tabulated and have steep sides."""


@lru_cache(maxsize=64)
def roman_bandpass(band: str, n_waves: int) -> Bandpass:
    """Return a Roman bandpass; the throughput is the effective area over galsim.roman.collecting_area."""
    return sampled(band, galsim_roman_bandpasses()[band], galsim.roman.collecting_area, n_waves)


@lru_cache(maxsize=1)
def galsim_roman_bandpasses() -> dict[str, galsim.Bandpass]:
    """Return GalSim's Roman bandpasses with AB zero points."""
    return galsim.roman.getBandpasses(AB_zeropoint=True)


@lru_cache(maxsize=64)
def rubin_bandpass(band: str, n_waves: int, area: float) -> Bandpass:
    """Return an LSST bandpass: atmosphere, mirrors, lenses, filter and detector, for a collecting area in cm2."""
    path = Path(galsim.meta_data.share_dir) / "bandpasses" / f"LSST_{band}.dat"
    return sampled(band, galsim.Bandpass(str(path), "nm"), area, n_waves)


def sampled(name: str, bandpass: galsim.Bandpass, area: float, n_waves: int) -> Bandpass:
    """Return a bandpass as means over cells of the common grid, with PSF nodes from its blue to its red limit."""
    wave = log_grid(bandpass.blue_limit, bandpass.red_limit)
    widths = cell_widths(wave)
    fine = wave[:, None] * np.exp(LOG_STEP * ((np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5))
    inside = (fine >= bandpass.blue_limit) & (fine <= bandpass.red_limit)
    throughput = np.where(inside, bandpass(np.clip(fine, bandpass.blue_limit, bandpass.red_limit)), 0.0)
    steps = fine * LOG_STEP / SUBSAMPLES
    # tails below a thousandth of the peak hold light but would only spread the nodes
    trimmed = bandpass.truncate(relative_throughput=1e-3)
    nodes = np.linspace(trimmed.blue_limit, trimmed.red_limit, n_waves)
    return Bandpass(
        name=name,
        wave=wave,
        throughput=(throughput * steps).sum(axis=1) / widths,
        area=area,
        nodes=nodes,
    )
