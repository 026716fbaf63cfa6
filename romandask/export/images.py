"""Export of images: exposures and tiles in FITS, a table of all of them (ObsCore), and maps of where they are (MOC)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from romandask.export import fits_images, obscore
from romandask.export.catalogs import indices_of, prepare
from romandask.export.fits_images import Plane
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.measurement.measurement_image import errors, rms_of
from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.exposures.exposures import Exposures, empty_variance
from romandask.survey import Survey

AREA_ORDER = 14
"""HEALPix order of maps of areas: cells of 13 arcsec."""


def export_fits(
    survey: Survey, folder: Path, name: str, exposures: Sequence[str], tiles: Sequence[str], bands: Sequence[str]
) -> list[Path]:
    """Write images of a survey as FITS, one file an exposure or tile and band, and return where they are.

    An exposure has the HDUs PRIMARY, SCI (electrons, with its sky), ERR and DQ; a tile SCI and ERR (nJy), DQ, WHT,
    NIMAGES and PSF. ERR of a tile is the scatter of an empty pixel.

    Parameters
    ----------
    name : of the survey
    exposures, tiles : names; of tiles `bands`, all where there are none

    Raises
    ------
    UserError
        If the survey has no such image, or it is not stored.
    """
    images = []
    if exposures:
        seen = survey.output(f"exposures/{name}")
        for index in units_named(seen.product, exposures, "exposure"):
            images.append((f"exposure-{name}-{seen.names[index]}", partial(_exposure, seen, index)))
    if tiles:
        coadds = survey.output(f"coadds/{name}")
        for index in tile_units(survey, name, tiles, bands):
            images.append((f"coadd-{name}-{coadds.names[index]}", partial(_tile, coadds, index)))
    prepare(folder)
    written = []
    for file, image in images:
        path = folder / f"{file}.fits"
        wcs, primary, planes = image()
        fits_images.write(path, {"ORIGIN": "romandask", "SURVEY": survey.pipeline.name} | primary, wcs, planes)
        written.append(path)
    return written


def tile_units(survey: Survey, name: str, tiles: Sequence[str], bands: Sequence[str]) -> list[int]:
    """Return the numbers of the units of tiles in some bands, all where none are named; UserError as `export_fits`."""
    known = survey.instruments[name].bands
    wrong = [band for band in bands if band not in known]
    if wrong:
        raise UserError(f"band {wrong[0]!r}: {name} has {', '.join(known)}")
    units = [f"{tile}-{band}" for tile in tiles for band in bands or known]
    return units_named(survey.output(f"coadds/{name}").product, units, "tile")


def units_named(product: ImageProduct, names: Sequence[str], kind: str) -> list[int]:
    """Return the numbers of units; UserError where the product has no such unit, or it is not stored."""
    indices = indices_of(product, names, kind, product.stage)
    for index in indices:
        if not product.has(index):
            raise UserError(f"{product.stage} {product.names[index]} is not stored: run the survey first")
    return indices


def _exposure(exposures: Exposures, index: int) -> tuple[dict, dict, list[Plane]]:
    instrument, exposure, header = exposures.instrument, exposures.exposure(index), exposures.header(index)
    arrays = exposures.load(index, ("image", "variance", "dq"))
    electrons = arrays["image"].astype(np.float32)

    def error() -> np.ndarray:
        return np.sqrt(arrays["variance"] if "variance" in arrays else counted(electrons, instrument.detector))

    sky = instrument.background(exposure, header)
    primary = {
        "TELESCOP": instrument.title,
        "FILTER": (exposure.band, "band"),
        "VISIT": (exposure.visit, "visit"),
        "DETECTOR": (exposure.detector, "detector (Roman: SCA)"),
        "MJD-OBS": (exposure.mjd, "start of the exposure, MJD"),
        "EXPTIME": (exposure.exptime, "s"),
        "ZPTMAG": (_zero_point(instrument.bandpass(exposure.band), exposure.exptime), "AB magnitude of one electron"),
        "SKYMEAN": (float(np.mean(sky)), "mean expected sky in SCI, electrons"),
        "SKYERR": (float(np.sqrt(np.mean(empty_variance(arrays, sky, instrument.detector)))), "rms of an empty pixel"),
    }
    planes = [
        Plane("SCI", lambda: electrons, "electron"),
        Plane("ERR", error, "electron"),
        Plane("DQ", lambda: arrays["dq"], cards=_cards(exposures.product)),
    ]
    return header, primary, planes


def counted(image: np.ndarray, detector: Detector) -> np.ndarray:
    """Return the variance as a pipeline would know it: the electrons that were counted, those of the sky among them."""
    return np.maximum(image, 0).astype(np.float32) + np.float32(detector.read_noise**2)


def _zero_point(bandpass: Any, seconds: float) -> float:
    return float(2.5 * np.log10(bandpass.ab_photons() * seconds))


def _tile(coadds: Coadds, index: int) -> tuple[dict, dict, list[Plane]]:
    here, scale, product = coadds.tile_band(index), coadds.instrument.coadd_scale, coadds.product

    def plane(name: str) -> np.ndarray:
        return product.load(index, (name,))[name]

    primary = {
        "TELESCOP": coadds.instrument.title,
        "FILTER": (here.band, "band"),
        "TILE": (here.tile.name, "tile of the survey's grid"),
        "NEXP": (len(here.members), "exposures that touch the tile"),
        "ZPTMAG": (31.4, "AB magnitude of one nJy"),
        "PIXSCALE": (scale, "arcsec"),
    }
    weight = next(variable for variable in product.variables if variable.name == "weight")
    planes = [
        Plane("SCI", lambda: plane("image"), "nJy"),
        Plane("ERR", lambda: tile_error(product, index), "nJy"),
        Plane("DQ", lambda: plane("dq"), cards=_cards(product)),
        Plane("WHT", lambda: plane("weight"), str(weight.attributes["units"])),
        Plane("NIMAGES", lambda: plane("nimages")),
        Plane("PSF", lambda: plane("psf"), on_sky=False, cards=(("PIXSCALE", scale),)),
    ]
    return coadds.header(index), primary, planes


def tile_error(product: ImageProduct, index: int) -> np.ndarray:
    """Return the scatter of the empty pixels of a tile, nJy; 0 where nothing is."""
    found = product.load(index, ("weight", "noise"))
    return errors(found["weight"], rms_of(found["noise"][0], found["weight"]))[0]


def flags_of(product: ImageProduct) -> dict[str, int]:
    """Return the bits of dq by what they mean."""
    attributes = next(variable for variable in product.variables if variable.name == "dq").attributes
    masks, words = attributes.get("flag_masks", []), str(attributes.get("flag_meanings", "")).split()
    return dict(zip(words, masks, strict=True))


def _cards(product: ImageProduct) -> tuple[tuple[str, str], ...]:
    """Return a card a bit of dq: what it means."""
    return tuple((f"BIT{int(mask).bit_length() - 1:02d}", word) for word, mask in flags_of(product).items())


def export_obscore(survey: Survey, path: Path) -> int:
    """Write all stored exposures and tiles as an ObsCore table, by the file's ending, and return their number.

    Raises
    ------
    UserError
        If the ending is none of .vot, .xml, .fits and .parquet, or nothing is stored.
    """
    obscore.check(path)
    parts = [_rows(survey, images) for name in survey.instruments for images in _images(survey, name)]
    rows = pd.concat([part for part in parts if len(part)] or [pd.DataFrame()], ignore_index=True)
    if not len(rows):
        raise UserError("no image is stored yet: run the survey first")
    prepare(path.parent)
    obscore.write(path, rows)
    return len(rows)


@dataclass(frozen=True)
class _Seen:
    """What an image is made of, and where it is."""

    exposures: pd.DataFrame
    """Rows of the pointings."""
    band: str
    corners: np.ndarray
    """(4, 2), degrees."""


@dataclass(frozen=True)
class _Images:
    """The exposures or the coadds of one survey, as archives describe them."""

    images: Exposures | Coadds
    calib_level: int
    unit: str
    pixel_scale: float
    seen: Callable[[int], _Seen]
    fwhm: Callable[[int], float]
    """Of the PSF of an image, arcsec; NaN where it is not known."""


def _images(survey: Survey, name: str) -> list[_Images]:
    """Return the images of one survey: coadds, and exposures where they are made."""
    coadds = survey.output(f"coadds/{name}")
    instrument, table = coadds.instrument, coadds.exposures.table

    def of_tile(index: int) -> _Seen:
        here = coadds.tile_band(index)
        return _Seen(table.iloc[here.members], here.band, coadds.footprints[index])

    def fwhm(index: int) -> float:
        return _fwhm(coadds.load(index, ("psf",))["psf"]) * instrument.coadd_scale

    found = [_Images(coadds, 3, "nJy", instrument.coadd_scale, of_tile, fwhm)]
    if instrument.coadd != "draw":
        exposures = survey.output(f"exposures/{name}")

        def of_exposure(index: int) -> _Seen:
            return _Seen(table.iloc[[index]], str(exposures.unit_bands[index]), exposures.footprints[index])

        # the PSF of an exposure would have to be drawn
        found.insert(0, _Images(exposures, 2, "electron", instrument.pixel_scale, of_exposure, lambda index: np.nan))
    return found


def _rows(survey: Survey, described: _Images) -> pd.DataFrame:
    """Return what ObsCore needs of every stored unit of an image product."""
    images, instrument = described.images, described.images.instrument
    product = images.product
    side, scale = images.image_shape, described.pixel_scale
    rows = []
    for index in (index for index in range(len(images.names)) if images.has(index)):
        seen = described.seen(index)
        exposures = seen.exposures
        wave = instrument.bandpass(seen.band).wave
        ends = exposures["mjd"] + exposures["exptime"] / 86400
        rows.append(
            {
                "obs_id": product.names[index],
                "stage": product.stage,
                "calib_level": described.calib_level,
                "corners": seen.corners,
                "fov": float(np.hypot(side[0], side[1]) * scale / 3600),
                "pixels": side,
                "pixel_scale": scale,
                "fwhm": described.fwhm(index),
                "t_min": float(exposures["mjd"].min()) if len(exposures) else np.nan,
                "t_max": float(ends.max()) if len(exposures) else np.nan,
                "t_exptime": float(exposures["exptime"].sum()),
                "em": (float(wave[0]), float(wave[-1])),
                "unit": described.unit,
                "bytes": sum(int(np.prod(v.shape)) * np.dtype(v.dtype).itemsize for v in product.variables),
                "survey": survey.pipeline.name,
                "facility": instrument.facility,
                "band": seen.band,
                "place": str(survey.store.images(product.stage)) if survey.store else "",
                "index": index,
            }
        )
    return pd.DataFrame(rows)


def _fwhm(psf: np.ndarray) -> float:
    """Return the diameter, pixels, of a circle as large as what is above half the peak; NaN without a PSF."""
    return float(2 * np.sqrt((psf > psf.max() / 2).sum() / np.pi)) if psf.max() > 0 else np.nan


def export_moc(survey: Survey, folder: Path) -> list[Path]:
    """Write where each stored image product has pixels, as MOC files (FITS), and return where they are.

    Raises
    ------
    UserError
        If nothing is stored, or the package mocpy is not there.
    """
    written = []
    for name in survey.instruments:
        for described in _images(survey, name):
            product = described.images.product
            polygons: dict[str, list[np.ndarray]] = {}
            for index in range(len(product.names)):
                if product.has(index):
                    seen = described.seen(index)
                    polygons.setdefault(seen.band, []).append(seen.corners)
            prepare(folder)
            for band, found in sorted(polygons.items()):
                path = folder / f"{product.stage.replace('/', '-')}-{band}.moc.fits"
                obscore.write_moc(path, found, AREA_ORDER)
                written.append(path)
    if not written:
        raise UserError("no image is stored yet: run the survey first")
    return written
