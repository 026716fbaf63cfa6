"""Roman images as the mission's data models (ASDF): exposures as level 2 images, tiles as level 3 mosaics.

Needs the packages roman_datamodels and gwcs.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from romandask.export.asdf_writer import MosaicMetadata, check_packages, write_exposure, write_mosaic
from romandask.export.command import export_command, report_written
from romandask.export.files import make_folder
from romandask.export.options import ExposureNames, Folder, StoreArgument, TileBands, TileNames
from romandask.export.planes import counted_variance, flags_of, tile_error
from romandask.export.selection import stored_units, tile_images
from romandask.instruments.exposure import pixel_areas
from romandask.model.errors import UserError
from romandask.model.sky import ARCSEC
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.exposures.exposures import Exposures
from romandask.survey import Survey, open_survey


def export_asdf(
    survey: Survey, folder: Path, exposures: Sequence[str], tiles: Sequence[str], bands: Sequence[str]
) -> list[Path]:
    """Write images of a stored survey as ASDF, one file for each exposure, and for each tile and band.

    An exposure is a level 2 image (roman_datamodels' ImageModel, electron/s, with the sky), a tile a level 3 mosaic
    (MosaicModel, MJy/sr). In a mosaic var_rnoise is the variance of an empty pixel, due to sky and detector;
    var_poisson is the variance due to the light of the objects, as if pixels were independent; the bits of context are
    the exposures of a pixel, in the order of meta.resample.members.

    Parameters
    ----------
    survey : Survey
        Stored survey. The images are those of the instrument for which the mission's data models exist.
    folder : Path
        Folder of the files.
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
        If the survey has no such image, the image is not stored, the folder cannot be created, or the packages are not
        installed.
    """
    check_packages()
    survey_name = _survey_with_data_models(survey)
    exposure_units, coadd_units = [], []
    if exposures:
        exposure_units = stored_units(survey.output(f"exposures/{survey_name}").product, exposures, "exposure")
    if tiles:
        coadd_units = tile_images(survey.output(f"coadds/{survey_name}"), tiles, bands)
    make_folder(folder)
    written = []
    if exposure_units:
        exposure_images: Exposures = survey.output(f"exposures/{survey_name}")
        for index in exposure_units:
            path = folder / f"exposure-{survey_name}-{exposure_images.names[index]}.asdf"
            _write_exposure(path, exposure_images, index)
            written.append(path)
    if coadd_units:
        coadds: Coadds = survey.output(f"coadds/{survey_name}")
        for index in coadd_units:
            path = folder / f"coadd-{survey_name}-{coadds.image_names[index]}.asdf"
            _write_mosaic(path, coadds, index, survey.pipeline.name)
            written.append(path)
    return written


def _survey_with_data_models(survey: Survey) -> str:
    """Return the name of the survey whose telescope has data models of its own."""
    for name, instrument in survey.instruments.items():
        if instrument.data_model_elements:
            return name
    raise UserError("export asdf is for the images of Roman, and this survey has none")


def _write_exposure(path: Path, exposures: Exposures, index: int) -> None:
    """Write an exposure as a level 2 image."""
    instrument, product = exposures.instrument, exposures.product
    exposure, header = exposures.exposure(index), exposures.header(index)
    arrays = product.load(index, ("image", "variance", "dq"))
    rate = np.float32(1 / exposure.exptime)
    variance = arrays["variance"] if "variance" in arrays else counted_variance(arrays["image"], instrument.detector)
    light = np.maximum(arrays["image"], 0).astype(np.float32)
    planes = {
        "data": arrays["image"].astype(np.float32) * rate,
        "err": np.sqrt(variance) * rate,
        "var_poisson": light * rate**2,
        "dq": arrays["dq"],
    }
    pixel_area = float(np.mean(pixel_areas(header, instrument.shape))) * ARCSEC**2
    write_exposure(
        path,
        planes,
        flags=flags_of(product),
        header=header,
        exposure=exposure,
        optical_element=instrument.data_model_elements[exposure.band],
        # a source of AB magnitude 0 has 3631 Jy and gives ab_photons electrons a second
        conversion=3631e-6 / instrument.bandpass(exposure.band).ab_photons() / pixel_area,
        pixel_area=pixel_area,
    )


def _write_mosaic(path: Path, coadds: Coadds, index: int, survey_name: str) -> None:
    """Write a tile in one band as a level 3 mosaic."""
    (tile, band), instrument = coadds.image_place(index), coadds.instrument
    arrays = coadds.read(tile, band, ("image", "weight"))
    numbers, sets = tile_sets(coadds, tile, band)
    pointings = coadds.exposures.table.iloc[coadds.tile_members(tile, band)]
    # nJy a pixel to MJy/sr
    surface_brightness = np.float32(1e-15 / (instrument.coadd_scale**2 * ARCSEC**2))
    error = tile_error(coadds, tile, band) * surface_brightness
    electrons_per_njy = instrument.bandpass(band).ab_photons() / 3631e9
    order = {name: rank for rank, name in enumerate(coadds.exposures.names)}
    members = tuple(sorted(set(sets["exposure"]), key=order.__getitem__))
    bit = {name: number for number, name in enumerate(members)}
    n_sets = int(sets["set"].max() if len(sets) else 0) + 1
    masks, seconds = np.zeros((-(-max(len(members), 1) // 32), n_sets), np.uint32), np.zeros(n_sets, np.float32)
    for number, name, time in zip(sets["set"], sets["exposure"], sets["seconds"], strict=True):
        masks[bit[name] // 32, number] |= np.uint32(1 << bit[name] % 32)
        seconds[number] += time
    exposed = seconds[numbers]
    light = np.maximum(arrays["image"], 0) / np.maximum(exposed * electrons_per_njy, 1e-6) * surface_brightness**2
    planes = {
        "data": arrays["image"] * surface_brightness,
        "err": error,
        "var_rnoise": error**2,
        "var_poisson": np.where(exposed > 0, light, 0).astype(np.float32),
        "weight": arrays["weight"],
        "context": masks[:, numbers],
    }
    metadata = MosaicMetadata(
        survey=survey_name,
        version=version("romandask"),
        tile=coadds.tiles[tile].name,
        optical_element=instrument.data_model_elements[band],
        pixel_scale=instrument.coadd_scale,
        native_scale=instrument.pixel_scale,
        pixfrac=coadds.settings.pixfrac,
        members=members,
        begin=float(pointings["mjd"].min()),
        end=float((pointings["mjd"] + pointings["exptime"] / 86400).max()),
        exposure_time=float(exposed[exposed > 0].mean()) if exposed.any() else 0.0,
    )
    write_mosaic(path, planes, coadds.header(index), metadata)


def tile_sets(coadds: Coadds, tile: int, band: str) -> tuple[np.ndarray, pd.DataFrame]:
    """Return the number of the set of exposures of each pixel of a tile, and the table of sets.

    Each patch numbers its own sets; those of a tile are numbered on from one patch to the next, and 0 stays the set
    without exposures.
    """
    numbers, tables, last = np.zeros(coadds.image_shape, np.int32), [], 0
    for unit in coadds.units_of(tile, band):
        loaded = coadds.load(unit, ("set", "sets"))
        own, table = loaded["set"].astype(np.int32), loaded["sets"]
        numbers[coadds.patch(unit).window] = np.where(own > 0, own + last, 0)
        tables.append(table.assign(set=table["set"] + last))
        last += int(own.max(initial=0))
    return numbers, pd.concat(tables, ignore_index=True)


@export_command("asdf")
def command(
    store: StoreArgument,
    out: Folder,
    exposure: ExposureNames = None,
    tile: TileNames = None,
    band: TileBands = None,
) -> None:
    """Write Roman exposures as level 2 images and tiles as level 3 mosaics, in ASDF, as roman_datamodels reads them."""
    survey = open_survey(store)
    if not exposure and not tile:
        raise UserError("export asdf needs --exposure or --tile, one or more")
    report_written(export_asdf(survey, out, exposure or [], tile or [], band or []))
