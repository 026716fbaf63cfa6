"""PSF at a position on a drizzled coadd, from the PSFs of the exposures that contribute at the position."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure, exposure_of
from romandask.instruments.psf_image import OVERSAMPLING, psf_image
from romandask.kernels.coadding.coadd_psf import drizzled_psf
from romandask.model.errors import UserError
from romandask.model.spectra import Bandpass
from romandask.stages.coadds.input_psfs import jacobian, psf_side, star_on
from romandask.stages.coadds.tile_maker import Coadds

Spectrum = Callable[[np.ndarray], np.ndarray]
"""Function that returns photons per nm, in any unit, at wavelengths in nm; for example a `galsim.SED`."""


@dataclass(frozen=True)
class ExposureAt:
    """An exposure that contains a position on the sky."""

    name: str
    exposure: Exposure
    wcs: WCS
    """WCS of the exposure."""
    x: float
    """Position on the detector along x, pixels."""
    y: float
    """Position on the detector along y, pixels."""


def coadd_psf(
    coadds: Coadds,
    ra: float,
    dec: float,
    band: str,
    stamp: int | None = None,
    scale: float | None = None,
    spectrum: Spectrum | None = None,
) -> xr.DataArray:
    """Return the image of a star of unit flux at a position on a drizzled coadd.

    The PSF is that of the exposures that contribute to the pixel at the position (Troxel et al. 2023, section 5.2). If
    the patch is stored, these are the exposures of the set of the pixel; otherwise all exposures whose detectors
    contain the position.

    Parameters
    ----------
    coadds : Coadds
        The coadds; they must be drizzled.
    ra, dec : float, degrees
        Position.
    band : str
        Band of the coadd.
    stamp : int, pixels, optional
        Side of the image; by default that of the stored PSFs.
    scale : float, arcsec, optional
        Distance between samples. The star is then in the middle of the image. A sample is the share of the light in a
        tile pixel that is centred on the sample, averaged over all positions of a star within the pixels of its
        exposures. By default the image has the pixels of the tile and shows this star as it is drizzled from its
        exposures, and so undersampled as they are.
    spectrum : Spectrum, optional
        Spectrum of the star; by default flat f_nu.

    Returns
    -------
    DataArray, dims (v, u)
        Image with the axes of the tile. Attributes: name of the tile (`tile`), names of the exposures (`exposures`),
        position of the star on the image (`x`, `y`, pixels) and `pixel_scale` (arcsec).

    Raises
    ------
    UserError
        If the coadds are not drizzled, there is no such band, the position is outside the tiles or on no exposure, or
        the spectrum gives no photons in the band or negative ones.
    """
    maker, instrument = coadds.maker, coadds.instrument
    if instrument.coadd != "drizzle":
        raise UserError(
            "PSFs at a position exist only for drizzled coadds: a patch of other coadds has one PSF, its array psf"
        )
    if band not in instrument.bands:
        raise UserError(f"band {band!r}: this survey has {', '.join(instrument.bands)}")
    owner = int(maker.settings.grid().owner(ra, dec))
    tiles = [k for k, tile in enumerate(maker.tiles) if tile.id == owner]
    if not tiles:
        raise UserError(f"({ra}, {dec}): outside the tiles of this survey")
    tile = maker.tiles[tiles[0]]
    header = maker.header(tiles[0])
    target = WCS(header)
    inputs = _exposures_at(coadds, tiles[0], band, ra, dec, target)
    if not inputs:
        raise UserError(f"({ra}, {dec}): no exposure of {band} there")
    stamp = psf_side(instrument) if stamp is None else stamp
    shares = None if spectrum is None else _shares(spectrum, instrument.bandpass(band))
    attributes: dict[str, Any] = {"tile": tile.name, "exposures": [each.name for each in inputs]}
    if scale is None:
        x, y = (float(value) for value in target.all_world2pix(ra, dec, 0))
        low_x, low_y = round(x) - stamp // 2, round(y) - stamp // 2
        stamp_wcs = WCS({**header, "CRPIX1": header["CRPIX1"] - low_x, "CRPIX2": header["CRPIX2"] - low_y})
        weighted = [(each.exposure, each.wcs, each.exposure.exptime) for each in inputs]
        image = star_on(stamp_wcs, stamp, ra, dec, weighted, instrument, maker.settings.pixfrac, shares)
        attributes |= {"x": x - low_x, "y": y - low_y, "pixel_scale": instrument.coadd_scale}
        return xr.DataArray(image, dims=("v", "u"), attrs=attributes)
    total, weight = np.zeros((stamp, stamp)), 0.0
    for each in inputs:
        derivative = jacobian(each.wcs, target, each.x, each.y)
        fine = psf_image(instrument, each.exposure, each.x, each.y, shares)
        step = scale / instrument.coadd_scale
        psf = drizzled_psf(fine, OVERSAMPLING, derivative, maker.settings.pixfrac, stamp, step)
        total += each.exposure.exptime * psf
        weight += each.exposure.exptime
    middle = (stamp - 1) / 2
    attributes |= {"x": middle, "y": middle, "pixel_scale": scale}
    return xr.DataArray((total / weight).astype(np.float32), dims=("v", "u"), attrs=attributes)


def _exposures_at(coadds: Coadds, tile: int, band: str, ra: float, dec: float, target: WCS) -> list[ExposureAt]:
    """Return the exposures that contribute at a position on a tile.

    Parameters
    ----------
    coadds : Coadds
        The coadds.
    tile : int
        Index of the tile.
    band : str
    ra, dec : float, degrees
        Position.
    target : WCS
        WCS of the tile.
    """
    table, instrument = coadds.exposures.table, coadds.instrument
    column, row = (int(round(float(value))) for value in target.all_world2pix(ra, dec, 0))
    (place,) = coadds.patches.touching((slice(row, row + 1), slice(column, column + 1)))
    index = coadds.index(tile, band, *place)
    patch = coadds.patch(index)
    members = patch.members
    if coadds.has(index):
        row, column = row - patch.corner[0], column - patch.corner[1]
        loaded = coadds.load(index, ("set", "sets"), (slice(row, row + 1), slice(column, column + 1)))
        sets = loaded["sets"]
        members = members[sets["input"][sets["set"] == int(loaded["set"].item())].to_numpy()]
    inputs = []
    ny, nx = instrument.shape
    for i in members:
        exposure = exposure_of(table.iloc[i])
        wcs = WCS(instrument.header(exposure))
        x, y = (float(value) for value in wcs.all_world2pix(ra, dec, 0, quiet=True))
        if -0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5:
            inputs.append(ExposureAt(coadds.exposures.names[i], exposure, wcs, x, y))
    return inputs


def _shares(spectrum: Spectrum, bandpass: Bandpass) -> np.ndarray:
    """Return the photons of a spectrum at each PSF node of a band, shape (nodes,).

    Raises
    ------
    UserError
        If there are no photons in the band, or negative or non-finite ones.
    """
    photons = (np.array([float(spectrum(wave)) for wave in bandpass.wave]) * bandpass.weights) @ bandpass.node_weights()
    if not (np.isfinite(photons).all() and photons.min() >= 0 and photons.sum() > 0):
        raise UserError("spectrum: it must give photons in the band, none negative")
    return photons
