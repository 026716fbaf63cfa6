"""FITS images of exposures and tiles: a checksummed extension for each plane (SCI, ERR, DQ, ...), with the full WCS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import ExposureNames, Folder, StoreArgument, TileBands, TileNames
from romandask.export.planes import counted_variance, flags_of, tile_error
from romandask.export.selection import stored_units, tile_images
from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.exposures.exposures import Exposures, empty_variance
from romandask.survey import Survey, open_survey

Cards = Mapping[str, Any]
"""FITS header cards by keyword: a value, or a value and a comment."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """An image extension."""

    name: str
    """EXTNAME."""
    make: Callable[[], np.ndarray]
    """Returns the array. It is called when the extension is written, because all planes of a tile may not fit in
    memory."""
    unit: str = ""
    """BUNIT; no card if empty."""
    has_wcs: bool = True
    """Whether the pixels are those of the image, so that its WCS holds."""
    cards: tuple[tuple[str, Any], ...] = ()
    """Further header cards: keyword and value."""


@dataclass(frozen=True)
class FitsImage:
    """Content of a FITS file."""

    primary: Cards
    """Cards of the primary HDU, which has no data."""
    wcs: Cards
    """Cards of the WCS, for each plane that has it."""
    planes: Sequence[Plane]
    """Extensions, in order."""


def export_fits(
    survey: Survey,
    folder: Path,
    survey_name: str,
    exposures: Sequence[str],
    tiles: Sequence[str],
    bands: Sequence[str],
) -> list[Path]:
    """Write images of a stored survey as FITS, one file for each exposure, and for each tile and band.

    The file of an exposure has the HDUs PRIMARY, SCI (electrons, with the sky), ERR and DQ. The file of a tile has SCI
    and ERR (nJy), DQ, WHT, NIMAGES and PSF; its ERR is the standard deviation of an empty pixel.

    Parameters
    ----------
    survey : Survey
        Stored survey.
    folder : Path
        Folder of the files.
    survey_name : str
        Name of the survey of one instrument, for example `roman`.
    exposures : sequence of str
        Names of exposures.
    tiles : sequence of str
        Names of tiles.
    bands : sequence of str
        Bands of the tiles; all bands if empty.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If the survey has no such image, the image is not stored, or the folder cannot be created.
    """
    images: list[tuple[str, Callable[[], FitsImage]]] = []
    if exposures:
        exposure_images: Exposures = survey.output(f"exposures/{survey_name}")
        for index in stored_units(exposure_images.product, exposures, "exposure"):
            name = f"exposure-{survey_name}-{exposure_images.names[index]}"
            images.append((name, partial(_exposure, exposure_images, index)))
    if tiles:
        coadds: Coadds = survey.output(f"coadds/{survey_name}")
        for index in tile_images(coadds, tiles, bands):
            images.append((f"coadd-{survey_name}-{coadds.image_names[index]}", partial(_tile, coadds, index)))
    make_folder(folder)
    written = []
    for name, make_image in images:
        path = folder / f"{name}.fits"
        image = make_image()
        primary = {"ORIGIN": "romandask", "SURVEY": survey.pipeline.name, **image.primary}
        write_fits(path, FitsImage(primary, image.wcs, image.planes))
        written.append(path)
    return written


def write_fits(path: Path, image: FitsImage) -> None:
    """Write an image as FITS; one plane is in memory at a time.

    Parameters
    ----------
    path : Path
        FITS file. It appears under its name when it is complete.
    image : FitsImage
        Content of the file.
    """
    primary = fits.PrimaryHDU()
    primary.header.update(image.primary)
    with completed(path) as temporary:
        primary.writeto(temporary, checksum=True)
        for plane in image.planes:
            header = fits.Header()
            if plane.has_wcs:
                header.update(image.wcs)
            if plane.unit:
                header["BUNIT"] = plane.unit
            header.update(dict(plane.cards))
            hdu = fits.ImageHDU(plane.make(), header, name=plane.name)
            with fits.open(temporary, mode="append", memmap=False) as hdus:
                hdus.append(hdu)
                hdu.add_checksum()
            # free the array before the next one is made
            del hdu


def _exposure(exposures: Exposures, index: int) -> FitsImage:
    """Return the content of the file of an exposure."""
    instrument, exposure, header = exposures.instrument, exposures.exposure(index), exposures.header(index)
    arrays = exposures.load(index, ("image", "variance", "dq"))
    electrons = arrays["image"].astype(np.float32)

    def error() -> np.ndarray:
        has_variance = "variance" in arrays
        return np.sqrt(arrays["variance"] if has_variance else counted_variance(electrons, instrument.detector))

    sky = instrument.background(exposure, header)
    empty = empty_variance(arrays, sky, instrument.detector)
    zero_point = float(2.5 * np.log10(instrument.bandpass(exposure.band).ab_photons() * exposure.exptime))
    primary = {
        "TELESCOP": instrument.title,
        "FILTER": (exposure.band, "band"),
        "VISIT": (exposure.visit, "visit"),
        "DETECTOR": (exposure.detector, "detector (Roman: SCA)"),
        "MJD-OBS": (exposure.mjd, "start of the exposure, MJD"),
        "EXPTIME": (exposure.exptime, "s"),
        "ZPTMAG": (zero_point, "AB magnitude of one electron"),
        "SKYMEAN": (float(np.mean(sky)), "mean expected sky in SCI, electrons"),
        "SKYERR": (float(np.sqrt(np.mean(empty))), "rms of an empty pixel"),
    }
    planes = [
        Plane(name="SCI", make=lambda: electrons, unit="electron"),
        Plane(name="ERR", make=error, unit="electron"),
        Plane(name="DQ", make=lambda: arrays["dq"], cards=_flag_cards(exposures.product)),
    ]
    return FitsImage(primary, header, planes)


def _tile(coadds: Coadds, index: int) -> FitsImage:
    """Return the content of the file of a tile in one band."""
    (tile, band), scale, product = coadds.image_place(index), coadds.instrument.coadd_scale, coadds.product
    image = coadds.tile_image(tile, band)
    primary = {
        "TELESCOP": coadds.instrument.title,
        "FILTER": (band, "band"),
        "TILE": (coadds.tiles[tile].name, "tile of the survey's grid"),
        "NEXP": (len(coadds.tile_members(tile, band)), "exposures that touch the tile"),
        "ZPTMAG": (31.4, "AB magnitude of one nJy"),
        "PIXSCALE": (scale, "arcsec"),
    }
    weight = next(variable for variable in product.variables if variable.name == "weight")
    planes = [
        Plane(name="SCI", make=partial(image, "image"), unit="nJy"),
        Plane(name="ERR", make=partial(tile_error, coadds, tile, band), unit="nJy"),
        Plane(name="DQ", make=partial(image, "dq"), cards=_flag_cards(product)),
        Plane(name="WHT", make=partial(image, "weight"), unit=str(weight.attributes["units"])),
        Plane(name="NIMAGES", make=partial(image, "nimages")),
        # mean over the patches of the tile
        Plane(name="PSF", make=partial(coadds.tile_psf, tile, band), has_wcs=False, cards=(("PIXSCALE", scale),)),
    ]
    return FitsImage(primary, coadds.header(index), planes)


def _flag_cards(product: ImageProduct) -> tuple[tuple[str, str], ...]:
    """Return a card for each bit of `dq`, with the name of the flag."""
    return tuple((f"BIT{int(mask).bit_length() - 1:02d}", name) for name, mask in flags_of(product).items())


@export_command("fits")
def command(
    store: StoreArgument,
    out: Folder,
    survey: Annotated[
        str | None, typer.Option("--survey", help="Survey of the images; default: the one of the finest pixels.")
    ] = None,
    exposure: ExposureNames = None,
    tile: TileNames = None,
    band: TileBands = None,
) -> None:
    """Write exposures or tiles as FITS with SCI, ERR and DQ: one file for each exposure, or tile and band."""
    opened = open_survey(store)
    survey = opened.sharpest if survey is None else survey
    if survey not in opened.instruments:
        raise UserError(f"--survey {survey}: this survey has {', '.join(opened.instruments)}")
    if not exposure and not tile:
        raise UserError("export fits needs --exposure or --tile, one or more")
    report_written(export_fits(opened, out, survey, exposure or [], tile or [], band or []))
