"""PSF images of exposures (FITS): a unit star, sampled finer than the pixels of the exposure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import Folder, StoreArgument
from romandask.export.selection import indices_of
from romandask.instruments.exposure import Exposure, exposure_of
from romandask.survey import Survey, open_survey


def export_psf(survey: Survey, folder: Path, names: Sequence[str]) -> list[Path]:
    """Write the PSF images of exposures of the sharpest survey, one FITS file for each exposure.

    Parameters
    ----------
    survey : Survey
        Survey, stored or not. The exposures are those of `survey.sharpest`.
    folder : Path
        Folder of the files.
    names : sequence of str
        Names of exposures.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If the survey has no such exposure, or the folder cannot be created.
    """
    product = survey.output(f"psfs/{survey.sharpest}")
    indices = indices_of(product.names, names, "exposure", "this survey")
    make_folder(folder)
    attributes = product.variables[0].attributes
    pointings = survey.pointings(survey.sharpest)
    written = []
    for name, index in zip(names, indices, strict=True):
        path = folder / f"psf-{name}.fits"
        exposure = exposure_of(pointings.iloc[index])
        write_psf(path, product.load(index)["psf"], attributes["oversampling"], attributes["pixel_scale"], exposure)
        written.append(path)
    return written


def write_psf(path: Path, image: np.ndarray, oversampling: int, pixel_scale: float, exposure: Exposure) -> None:
    """Write one PSF image to the first HDU of a FITS file.

    Parameters
    ----------
    path : Path
        FITS file.
    image : ndarray, shape (n, n)
        Share of the light of a unit star in a native pixel, at each sample.
    oversampling : int
        Number of samples along a native pixel.
    pixel_scale : float, arcsec
        Distance between samples.
    exposure : Exposure
        Exposure of the PSF.
    """
    hdu = fits.PrimaryHDU(np.asarray(image, np.float32))
    header = hdu.header
    header["VISIT"] = (int(exposure.visit), "visit")
    header["DETECTOR"] = (int(exposure.detector), "detector (Roman: SCA)")
    header["FILTER"] = (str(exposure.band), "band")
    header["MJD-OBS"] = (float(exposure.mjd), "start of the exposure, MJD")
    header["OVERSAMP"] = (int(oversampling), "samples along a native pixel")
    header["PIXSCALE"] = (float(pixel_scale), "arcsec between samples")
    header["BUNIT"] = ("1/pixel", "share of a unit star's light in a native pixel")
    header["CRPIX1"] = (image.shape[1] // 2 + 1, "sample on which the star is centred")
    header["CRPIX2"] = (image.shape[0] // 2 + 1, "sample on which the star is centred")
    with completed(path) as temporary:
        hdu.writeto(temporary, checksum=True)


@export_command("psf")
def command(
    store: StoreArgument,
    out: Folder,
    exposure: Annotated[list[str], typer.Option("--exposure", help="Name, for example H158-12-7; may be repeated.")],
) -> None:
    """Write PSF images of Roman exposures (FITS): a unit star, 8 samples a pixel."""
    report_written(export_psf(open_survey(store), out, exposure))
