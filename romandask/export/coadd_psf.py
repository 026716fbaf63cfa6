"""PSF images of coadds at a position (FITS): a unit star, drizzled like the exposures of that position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import Bands, Folder, StoreArgument
from romandask.survey import Survey, open_survey


def export_coadd_psf(
    survey: Survey, folder: Path, ra: float, dec: float, bands: Sequence[str], scale: float | None
) -> list[Path]:
    """Write the PSF of drizzled coadds at a position, one FITS file for each band.

    Parameters
    ----------
    survey : Survey
        Survey, stored or not.
    folder : Path
        Folder of the files.
    ra, dec : float, degrees
        Position.
    bands : sequence of str
        Bands; if empty, all bands of `survey.sharpest`.
    scale : float or None, arcsec
        Distance between samples; None for the pixels of the coadd.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If the survey has no such band or no exposure of the band at the position, or the folder cannot be created.
    """
    all_bands = survey.instruments[survey.sharpest].bands
    images = {band: survey.psf(ra, dec, band, scale=scale) for band in bands or all_bands}
    make_folder(folder)
    written = []
    for band, image in images.items():
        path = folder / f"psf-{band}-{ra:.5f}_{dec:+.5f}.fits"
        write_coadd_psf(path, image.to_numpy(), {**image.attrs, "ra": ra, "dec": dec, "band": band})
        written.append(path)
    return written


def write_coadd_psf(path: Path, image: np.ndarray, description: Mapping[str, Any]) -> None:
    """Write the PSF image of a coadd at a position to the first HDU of a FITS file.

    Parameters
    ----------
    path : Path
        FITS file.
    image : ndarray, shape (n, n)
        Share of the light of a unit star in a coadd pixel, at each sample.
    description : mapping
        ra, dec (degrees), band, tile, exposures (names), pixel_scale (arcsec between samples), and x and y: pixel
        coordinates of the star on the image, 0 at the centre of the first pixel.
    """
    hdu = fits.PrimaryHDU(np.asarray(image, np.float32))
    header = hdu.header
    header["RA"] = (float(description["ra"]), "degrees")
    header["DEC"] = (float(description["dec"]), "degrees")
    header["FILTER"] = (str(description["band"]), "band")
    header["TILE"] = (str(description["tile"]), "tile of the coadd")
    header["PIXSCALE"] = (float(description["pixel_scale"]), "arcsec between samples")
    header["BUNIT"] = ("1/pixel", "share of a unit star's light in a coadd pixel")
    header["CRPIX1"] = (float(description["x"]) + 1, "where the star is centred")
    header["CRPIX2"] = (float(description["y"]) + 1, "where the star is centred")
    for number, name in enumerate(description["exposures"]):
        header[f"EXP{number:05d}"] = (name, "exposure: band, visit, SCA")
    with completed(path) as temporary:
        hdu.writeto(temporary, checksum=True)


@export_command("coadd-psf")
def command(
    store: StoreArgument,
    out: Folder,
    at: Annotated[tuple[float, float], typer.Option("--at", metavar="RA DEC", help="Degrees.")],
    band: Bands = None,
    scale: Annotated[
        float | None,
        typer.Option("--scale", min=1e-3, help="Arcsec between samples; default: the coadd's own pixels."),
    ] = None,
) -> None:
    """Write the PSF of Roman's coadds at a position (FITS): a unit star, drizzled like the exposures there."""
    report_written(export_coadd_psf(open_survey(store), out, *at, band or [], scale))
