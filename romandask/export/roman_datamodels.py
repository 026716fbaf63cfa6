"""Export of Roman's images as the mission's own data models: exposures as level 2, tiles as level 3, in ASDF."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from romandask.export import roman_asdf
from romandask.export.catalogs import prepare
from romandask.export.images import counted, flags_of, tile_error, tile_units, units_named
from romandask.instruments.exposure import pixel_areas
from romandask.model.errors import UserError
from romandask.model.sky import ARCSEC
from romandask.stages.coadds.tile_maker import Coadds
from romandask.survey import Survey


def export_asdf(survey: Survey, folder: Path, exposures: Sequence[str]) -> list[Path]:
    """Write Roman's exposures as level 2 images (roman_datamodels' ImageModel, electron/s with its sky).

    Raises
    ------
    UserError
        If the survey has no such exposure, it is not stored, or the package roman_datamodels is not there.
    """
    roman_asdf.available()
    name = _survey_of(survey)
    images = survey.output(f"exposures/{name}")
    instrument, product = images.instrument, images.product
    chosen = units_named(product, exposures, "exposure")
    flags = flags_of(product)
    prepare(folder)
    written = []
    for index in chosen:
        exposure, header = images.exposure(index), images.header(index)
        arrays = product.load(index, ("image", "variance", "dq"))
        rate = np.float32(1 / exposure.exptime)
        variance = arrays["variance"] if "variance" in arrays else counted(arrays["image"], instrument.detector)
        light = np.maximum(arrays["image"], 0).astype(np.float32)
        planes = {
            "data": arrays["image"].astype(np.float32) * rate,
            "err": np.sqrt(variance) * rate,
            "var_poisson": light * rate**2,
            "dq": arrays["dq"],
        }
        area = float(np.mean(pixel_areas(header, instrument.shape))) * ARCSEC**2
        # AB: 3631 Jy give ab_photons electrons a second
        photometry = 3631e-6 / instrument.bandpass(exposure.band).ab_photons() / area, area
        element = instrument.data_model_elements[exposure.band]
        path = folder / f"exposure-{name}-{product.names[index]}.asdf"
        roman_asdf.write(path, planes, flags, header, vars(exposure) | {"optical_element": element}, photometry)
        written.append(path)
    return written


def export_mosaics(survey: Survey, folder: Path, tiles: Sequence[str], bands: Sequence[str]) -> list[Path]:
    """Write Roman's tiles as level 3 mosaics (roman_datamodels' MosaicModel, MJy/sr), one file a tile and band.

    var_rnoise is the variance of an empty pixel, sky and detector; var_poisson that of the objects' light, as if pixels
    were independent; the bits of context are the exposures of the pixel, in the order of meta.resample.members.

    Raises
    ------
    UserError
        If the survey has no such tile or band, it is not stored, or the package roman_datamodels is not there.
    """
    roman_asdf.available()
    name = _survey_of(survey)
    coadds = survey.output(f"coadds/{name}")
    chosen = tile_units(survey, name, tiles, bands)
    prepare(folder)
    written = []
    for index in chosen:
        path = folder / f"coadd-{name}-{coadds.names[index]}.asdf"
        roman_asdf.write_mosaic(path, *_mosaic(survey, coadds, index))
        written.append(path)
    return written


def _survey_of(survey: Survey) -> str:
    """Return the survey whose telescope has data models of its own."""
    for name, instrument in survey.instruments.items():
        if instrument.data_model_elements:
            return name
    raise UserError("export asdf is for the images of Roman, and this survey has none")


def _mosaic(survey: Survey, coadds: Coadds, index: int) -> tuple[dict, dict, roman_asdf.Mosaic]:
    here, instrument = coadds.tile_band(index), coadds.instrument
    found = coadds.load(index, ("image", "weight", "set", "sets"))
    sets, rows = found["sets"], coadds.exposures.table.iloc[here.members]
    # nJy a pixel to MJy/sr
    surface = np.float32(1e-15 / (instrument.coadd_scale**2 * ARCSEC**2))
    weight = found["weight"]
    error = tile_error(coadds.product, index) * surface
    electrons = instrument.bandpass(here.band).ab_photons() / 3631e9
    names = tuple(sets.drop_duplicates("input").sort_values("input")["exposure"])
    bit = {name: k for k, name in enumerate(names)}
    count = int(sets["set"].max() if len(sets) else 0) + 1
    masks, seconds = np.zeros((-(-max(len(names), 1) // 32), count), np.uint32), np.zeros(count, np.float32)
    for number, name, time in zip(sets["set"], sets["exposure"], sets["seconds"], strict=True):
        masks[bit[name] // 32, number] |= np.uint32(1 << bit[name] % 32)
        seconds[number] += time
    exposed = seconds[found["set"]]
    light = np.maximum(found["image"], 0) / np.maximum(exposed * electrons, 1e-6) * surface**2
    planes = {
        "data": found["image"] * surface,
        "err": error,
        "var_rnoise": error**2,
        "var_poisson": np.where(exposed > 0, light, 0).astype(np.float32),
        "weight": weight,
        "context": masks[:, found["set"]],
    }
    about = roman_asdf.Mosaic(
        survey.pipeline.name,
        version("romandask"),
        here.tile.name,
        instrument.data_model_elements[here.band],
        instrument.coadd_scale,
        instrument.pixel_scale,
        coadds.settings.pixfrac,
        names,
        float(rows["mjd"].min()),
        float((rows["mjd"] + rows["exptime"] / 86400).max()),
        float(exposed[exposed > 0].mean()) if exposed.any() else 0.0,
    )
    return planes, coadds.header(index), about
