"""The PSF of a drizzled coadd anywhere: from the exposures that a place has, each with its own PSF there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of
from romandask.instruments.instrument import Instrument
from romandask.kernels.coadding.coadd_psf import drizzled_psf
from romandask.model.errors import UserError
from romandask.model.spectra import Bandpass
from romandask.stages.coadds.input_psfs import jacobian, psf_side, star_on
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.psf_images import OVERSAMPLING, psf_image

Spectrum = Callable[[np.ndarray], np.ndarray]
"""Photons per nm, in any unit, at wavelengths in nm: a `galsim.SED`, for example."""


@dataclass(frozen=True)
class Seen:
    """An exposure that sees a place."""

    name: str
    exposure: Exposure
    wcs: WCS
    x: float
    y: float


def coadd_psf(
    coadds: Coadds,
    ra: float,
    dec: float,
    band: str,
    stamp: int | None = None,
    scale: float | None = None,
    spectrum: Spectrum | None = None,
) -> xr.DataArray:
    """Return the image of a unit star at a place of a drizzled coadd, dims (v, u), axes those of the tile.

    Parameters
    ----------
    ra, dec : degrees
    stamp : pixels a side; that of the stored PSFs where none is given
    scale : arcsec between samples, each the share of light in a pixel of the coadd that is centred there, the star in
        the middle: the mean over all places that a star may have in the pixels of its exposures. None for the pixels
        of the coadd themselves, and for the very places of this star: what the coadd has of it, undersampled as its
        exposures are. The attributes `x` and `y` then tell where in the stamp it is centred.
    spectrum : of the star; flat f_nu where none is given

    The exposures are those of the place's set, where the tile is stored, else all whose detectors hold the place
    (Troxel et al. 2023, section 5.2). Attributes: tile, exposures, pixel_scale.

    Raises
    ------
    UserError
        If the survey has no such band, or no exposure at the place.
    """
    maker, instrument = coadds.maker, coadds.instrument
    if instrument.coadd != "drizzle":
        raise UserError("PSFs at a place are those of drizzled coadds: of others each tile has one, its array psf")
    if band not in instrument.bands:
        raise UserError(f"band {band!r}: this survey has {', '.join(instrument.bands)}")
    owner = int(maker.settings.grid().owner(ra, dec))
    tiles = [k for k, tile in enumerate(maker.tiles) if tile.id == owner]
    if not tiles:
        raise UserError(f"({ra}, {dec}): outside the tiles of this survey")
    tile, index = maker.tiles[tiles[0]], coadds.index(tiles[0], band)
    header = maker.header(tiles[0])
    target = WCS(header)
    seen = _seen(coadds, index, maker.members[tiles[0], band], instrument, ra, dec, target)
    if not seen:
        raise UserError(f"({ra}, {dec}): no exposure of {band} there")
    stamp = psf_side(instrument) if stamp is None else stamp
    shares = None if spectrum is None else _shares(spectrum, instrument.bandpass(band))
    attributes = {"tile": tile.name, "exposures": [one.name for one in seen]}
    if scale is None:
        x, y = (float(value) for value in target.all_world2pix(ra, dec, 0))
        low_x, low_y = round(x) - stamp // 2, round(y) - stamp // 2
        here = WCS({**header, "CRPIX1": header["CRPIX1"] - low_x, "CRPIX2": header["CRPIX2"] - low_y})
        inputs = [(one.exposure, one.wcs, one.exposure.exptime) for one in seen]
        image = star_on(here, stamp, ra, dec, inputs, instrument, maker.settings.pixfrac, shares)
        attributes |= {"x": x - low_x, "y": y - low_y, "pixel_scale": instrument.coadd_scale}
        return xr.DataArray(image, dims=("v", "u"), attrs=attributes)
    total, weight = np.zeros((stamp, stamp)), 0.0
    for one in seen:
        change = jacobian(one.wcs, target, one.x, one.y)
        fine = psf_image(instrument, one.exposure, one.x, one.y, shares)
        step = scale / instrument.coadd_scale
        total += one.exposure.exptime * drizzled_psf(fine, OVERSAMPLING, change, maker.settings.pixfrac, stamp, step)
        weight += one.exposure.exptime
    middle = (stamp - 1) / 2
    attributes |= {"x": middle, "y": middle, "pixel_scale": scale}
    return xr.DataArray((total / weight).astype(np.float32), dims=("v", "u"), attrs=attributes)


def _seen(
    coadds: Coadds, index: int, members: np.ndarray, instrument: Instrument, ra: float, dec: float, target: WCS
) -> list[Seen]:
    """Return the exposures, of those that touch a tile, of which a place of it is made."""
    table = coadds.exposures.table
    if coadds.has(index):
        column, row = (int(round(float(value))) for value in target.all_world2pix(ra, dec, 0))
        found = coadds.load(index, ("set", "sets"), (slice(row, row + 1), slice(column, column + 1)))
        sets = found["sets"]
        members = members[sets["input"][sets["set"] == int(found["set"].item())].to_numpy()]
    seen = []
    ny, nx = instrument.shape
    for i in members:
        exposure = exposure_of(table.iloc[i])
        wcs = WCS(instrument.header(exposure))
        x, y = (float(value) for value in wcs.all_world2pix(ra, dec, 0, quiet=True))
        if -0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5:
            seen.append(Seen(coadds.exposures.names[i], exposure, wcs, x, y))
    return seen


def _shares(spectrum: Spectrum, bandpass: Bandpass) -> np.ndarray:
    photons = (np.array([float(spectrum(wave)) for wave in bandpass.wave]) * bandpass.weights) @ bandpass.node_weights()
    if not (np.isfinite(photons).all() and photons.min() >= 0 and photons.sum() > 0):
        raise UserError("spectrum: it must give photons in the band, none negative")
    return photons
