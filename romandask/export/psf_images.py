"""PSF images in FITS: a unit star sampled finer than the pixels of its exposure, with what it belongs to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits


def write(path: Path, image: np.ndarray, oversampling: int, pixel_scale: float, exposure: dict) -> None:
    """Write one PSF image (side, side) to the first HDU.

    Parameters
    ----------
    oversampling : samples along a native pixel
    pixel_scale : arcsec between samples
    exposure : visit, detector, band and mjd, by name
    """
    hdu = fits.PrimaryHDU(np.asarray(image, np.float32))
    header = hdu.header
    header["VISIT"] = (int(exposure["visit"]), "visit")
    header["DETECTOR"] = (int(exposure["detector"]), "detector (Roman: SCA)")
    header["FILTER"] = (str(exposure["band"]), "band")
    header["MJD-OBS"] = (float(exposure["mjd"]), "start of the exposure, MJD")
    header["OVERSAMP"] = (int(oversampling), "samples along a native pixel")
    header["PIXSCALE"] = (float(pixel_scale), "arcsec between samples")
    header["BUNIT"] = ("1/pixel", "share of a unit star's light in a native pixel")
    header["CRPIX1"] = (image.shape[1] // 2 + 1, "sample on which the star is centred")
    header["CRPIX2"] = (image.shape[0] // 2 + 1, "sample on which the star is centred")
    hdu.writeto(path, overwrite=True, checksum=True)


def write_coadd(path: Path, image: np.ndarray, place: dict) -> None:
    """Write the PSF image (side, side) of a coadd at a place to the first HDU.

    Parameters
    ----------
    place : ra, dec (degrees), band, tile, exposures (names), pixel_scale (arcsec), x and y (pixels, from 0) of the star
    """
    hdu = fits.PrimaryHDU(np.asarray(image, np.float32))
    header = hdu.header
    header["RA"], header["DEC"] = (float(place["ra"]), "degrees"), (float(place["dec"]), "degrees")
    header["FILTER"] = (str(place["band"]), "band")
    header["TILE"] = (str(place["tile"]), "tile of the coadd")
    header["PIXSCALE"] = (float(place["pixel_scale"]), "arcsec between samples")
    header["BUNIT"] = ("1/pixel", "share of a unit star's light in a coadd pixel")
    header["CRPIX1"] = (float(place["x"]) + 1, "where the star is centred")
    header["CRPIX2"] = (float(place["y"]) + 1, "where the star is centred")
    for number, name in enumerate(place["exposures"]):
        header[f"EXP{number:05d}"] = (name, "exposure: band, visit, SCA")
    hdu.writeto(path, overwrite=True, checksum=True)
