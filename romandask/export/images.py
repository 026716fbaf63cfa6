"""Export of images: exposures and tiles in FITS, a table of all of them (ObsCore), and maps of where they are (MOC)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from romandask.export import fits_images, obscore
from romandask.export.catalogs import indices_of, prepare
from romandask.export.fits_images import Plane
from romandask.instruments.instrument import exposure_of
from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.measurement.measurement_image import errors, rms_of
from romandask.model.errors import UserError
from romandask.products.images import ImageProduct
from romandask.stages.coadds.tile_maker import source_of, tile_maker
from romandask.stages.exposures import empty_variance
from romandask.stages.pointings import corners_of
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
    name : roman or rubin
    exposures, tiles : names; of tiles `bands`, all where there are none

    Raises
    ------
    UserError
        If the survey has no such image, or it is not stored.
    """
    chosen = []
    if exposures:
        product = survey.output(f"exposures/{name}")
        chosen += [(product, index, f"exposure-{name}") for index in units_named(product, exposures, "exposure")]
    if tiles:
        product = survey.output(f"coadds/{name}")
        chosen += [(product, index, f"coadd-{name}") for index in tile_units(survey, name, tiles, bands)]
    prepare(folder)
    written = []
    for product, index, kind in chosen:
        path = folder / f"{kind}-{product.names[index]}.fits"
        wcs, primary, planes = (_exposure if product.stage.startswith("exposures") else _tile)(product, index)
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
    return units_named(survey.output(f"coadds/{name}"), units, "tile")


def units_named(product: ImageProduct, names: Sequence[str], kind: str) -> list[int]:
    """Return the numbers of units; UserError where the product has no such unit, or it is not stored."""
    indices = indices_of(product, names, kind, product.stage)
    for index in indices:
        if not product.has(index):
            raise UserError(f"{product.stage} {product.names[index]} is not stored: run the survey first")
    return indices


def _exposure(product: ImageProduct, index: int) -> tuple[dict, dict, list[Plane]]:
    source = source_of(product)
    instrument, exposure = source.instrument, exposure_of(source.table.iloc[index])
    header = instrument.header(exposure)
    arrays = product.load(index, ("image", "variance", "dq"))
    electrons = arrays["image"].astype(np.float32)

    def error() -> np.ndarray:
        return np.sqrt(arrays["variance"] if "variance" in arrays else counted(electrons, instrument.detector))

    sky = instrument.background(exposure, header)
    primary = {
        "TELESCOP": instrument.name.capitalize(),
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
        Plane("DQ", lambda: arrays["dq"], cards=_cards(product)),
    ]
    return header, primary, planes


def counted(image: np.ndarray, detector: Detector) -> np.ndarray:
    """Return the variance as a pipeline would know it: the electrons that were counted, those of the sky among them."""
    return np.maximum(image, 0).astype(np.float32) + np.float32(detector.read_noise**2)


def _zero_point(bandpass: Any, seconds: float) -> float:
    return float(2.5 * np.log10(bandpass.ab_photons() * seconds))


def _tile(product: ImageProduct, index: int) -> tuple[dict, dict, list[Plane]]:
    maker = tile_maker(product)
    here, scale = maker.unit(index), maker.instrument.coadd_scale
    tile = index // len(maker.instrument.bands)

    def plane(name: str) -> np.ndarray:
        return product.load(index, (name,))[name]

    primary = {
        "TELESCOP": maker.instrument.name.capitalize(),
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
    return maker.header(tile), primary, planes


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
    parts = [_rows(survey, name, product) for name in survey.instruments for product in _images(survey, name)]
    rows = pd.concat([part for part in parts if len(part)] or [pd.DataFrame()], ignore_index=True)
    if not len(rows):
        raise UserError("no image is stored yet: run the survey first")
    prepare(path.parent)
    obscore.write(path, rows)
    return len(rows)


def _images(survey: Survey, name: str) -> list[ImageProduct]:
    """Return the image products of one survey that are stored."""
    found = [survey.output(f"coadds/{name}")]
    if survey.instruments[name].coadd != "draw":
        found.insert(0, survey.output(f"exposures/{name}"))
    return found


def _rows(survey: Survey, name: str, product: ImageProduct) -> pd.DataFrame:
    """Return what ObsCore needs of every stored unit of an image product."""
    instrument = survey.instruments[name]
    stored = [index for index in range(len(product.names)) if product.has(index)]
    table = survey.pointings(name)
    of_tiles = product.stage.startswith("coadds")
    side, scale = product.variables[0].shape, instrument.coadd_scale if of_tiles else instrument.pixel_scale
    rows = []
    for index in stored:
        seen, band, corners = _seen(product, table, index)
        seconds = float(seen["exptime"].sum())
        wave = instrument.bandpass(band).wave
        ends = seen["mjd"] + seen["exptime"] / 86400
        rows.append(
            {
                "obs_id": product.names[index],
                "stage": product.stage,
                "calib_level": 3 if of_tiles else 2,
                "corners": corners,
                "fov": float(np.hypot(side[0], side[1]) * scale / 3600),
                "pixels": side,
                "pixel_scale": scale,
                # an exposure's PSF would have to be drawn
                "fwhm": _fwhm(product.load(index, ("psf",))["psf"]) * scale if of_tiles else np.nan,
                "t_min": float(seen["mjd"].min()) if len(seen) else np.nan,
                "t_max": float(ends.max()) if len(seen) else np.nan,
                "t_exptime": seconds,
                "em": (float(wave[0]), float(wave[-1])),
                "unit": "nJy" if of_tiles else "electron",
                "bytes": sum(int(np.prod(v.shape)) * np.dtype(v.dtype).itemsize for v in product.variables),
                "survey": survey.pipeline.name,
                "instrument": name,
                "band": band,
                "place": str(survey.store.images(product.stage)) if survey.store else "",
                "index": index,
            }
        )
    return pd.DataFrame(rows)


def _seen(product: ImageProduct, table: pd.DataFrame, index: int) -> tuple[pd.DataFrame, str, np.ndarray]:
    """Return the exposures (rows of the pointings) of which an image is made, its band, its corners (4, 2; degrees)."""
    if product.stage.startswith("coadds"):
        maker = tile_maker(product)
        here = maker.unit(index)
        return table.iloc[here.members], here.band, here.tile.corners(maker.settings.grid().side)
    seen = table.iloc[[index]]
    return seen, str(seen["band"].iloc[0]), corners_of(seen)[0]


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
        table = survey.pointings(name)
        for product in _images(survey, name):
            polygons: dict[str, list[np.ndarray]] = {}
            for index in range(len(product.names)):
                if product.has(index):
                    _, band, corners = _seen(product, table, index)
                    polygons.setdefault(band, []).append(corners)
            prepare(folder)
            for band, found in sorted(polygons.items()):
                path = folder / f"{product.stage.replace('/', '-')}-{band}.moc.fits"
                obscore.write_moc(path, found, AREA_ORDER)
                written.append(path)
    if not written:
        raise UserError("no image is stored yet: run the survey first")
    return written
