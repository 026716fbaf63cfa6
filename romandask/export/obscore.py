"""ObsCore 1.1 tables of stored images: a row for each image, in the columns by which archives describe observations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from astropy.table import Table

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.observations import ObservedImages, observed_images
from romandask.export.options import StoreArgument
from romandask.model.errors import UserError
from romandask.survey import Survey, open_survey

ENDINGS = {".vot": "votable", ".xml": "votable", ".fits": "fits", ".parquet": "parquet"}
"""Table format, by the ending of the file."""
UCDS = {"nJy": "phot.flux.density", "electron": "phot.count"}
"""UCD of the pixel values, by their unit."""
COLUMNS: dict[str, tuple[str, str]] = {
    "dataproduct_type": ("", "meta.code.class"),
    "calib_level": ("", "meta.code;obs.calib"),
    "obs_collection": ("", "meta.id"),
    "obs_id": ("", "meta.id"),
    "obs_publisher_did": ("", "meta.ref.ivoid"),
    "access_url": ("", "meta.ref.url"),
    "access_format": ("", "meta.code.mime"),
    "access_estsize": ("kbyte", "phys.size;meta.file"),
    "target_name": ("", "meta.id;src"),
    "s_ra": ("deg", "pos.eq.ra"),
    "s_dec": ("deg", "pos.eq.dec"),
    "s_fov": ("deg", "phys.angSize;instr.fov"),
    "s_region": ("", "pos.outline;obs.field"),
    "s_resolution": ("arcsec", "pos.angResolution"),
    "s_xel1": ("", "meta.number"),
    "s_xel2": ("", "meta.number"),
    "t_min": ("d", "time.start;obs.exposure"),
    "t_max": ("d", "time.end;obs.exposure"),
    "t_exptime": ("s", "time.duration;obs.exposure"),
    "t_resolution": ("s", "time.resolution"),
    "t_xel": ("", "meta.number"),
    "em_min": ("m", "em.wl;stat.min"),
    "em_max": ("m", "em.wl;stat.max"),
    "em_res_power": ("", "spect.resolution"),
    "em_xel": ("", "meta.number"),
    "o_ucd": ("", "meta.ucd"),
    "pol_states": ("", "meta.code;phys.polarization"),
    "pol_xel": ("", "meta.number"),
    "facility_name": ("", "meta.id;instr.tel"),
    "instrument_name": ("", "meta.id;instr"),
    "s_pixel_scale": ("arcsec", "phys.angSize;instr.pixel"),
    "em_band": ("", "instr.bandpass"),
}
"""Unit and UCD of each column: the mandatory columns of table 1 of ObsCore 1.1, then two optional columns."""


def export_obscore(survey: Survey, path: Path) -> int:
    """Write an ObsCore table of all stored exposures and tiles.

    Parameters
    ----------
    survey : Survey
        Stored survey.
    path : Path
        File; its ending determines the format.

    Returns
    -------
    int
        Number of images.

    Raises
    ------
    UserError
        If the ending is none of .vot, .xml, .fits and .parquet, no image is stored, or the folder of the file cannot be
        created.
    """
    if path.suffix not in ENDINGS:
        raise UserError(f"{path}: the ending must be one of {', '.join(ENDINGS)}")
    parts = [_rows(survey, observed) for observed in observed_images(survey)]
    rows = pd.concat([part for part in parts if len(part)] or [pd.DataFrame()], ignore_index=True)
    if not len(rows):
        raise UserError("no image is stored yet: run the survey first")
    make_folder(path.parent)
    write_obscore(path, rows)
    return len(rows)


def _rows(survey: Survey, observed: ObservedImages) -> pd.DataFrame:
    """Return the input of `table_of` for the stored units of an image product."""
    images, product = observed.images, observed.images.product
    shape, scale = images.image_shape, observed.pixel_scale
    rows = []
    for index in observed.stored():
        observation = observed.observation(index)
        exposures = observation.exposures
        wave = images.instrument.bandpass(observation.band).wave
        ends = exposures["mjd"] + exposures["exptime"] / 86400
        rows.append(
            {
                "obs_id": images.image_names[index],
                "stage": product.stage,
                "calib_level": observed.calib_level,
                "corners": observation.corners,
                "fov": float(np.hypot(shape[0], shape[1]) * scale / 3600),
                "shape": shape,
                "pixel_scale": scale,
                "fwhm": observed.psf_fwhm(index),
                "t_min": float(exposures["mjd"].min()) if len(exposures) else np.nan,
                "t_max": float(ends.max()) if len(exposures) else np.nan,
                "t_exptime": float(exposures["exptime"].sum()),
                "em": (float(wave[0]), float(wave[-1])),
                "unit": observed.unit,
                "bytes": sum(int(np.prod(v.shape)) * np.dtype(v.dtype).itemsize for v in product.variables),
                "survey": survey.pipeline.name,
                "facility": images.instrument.facility,
                "band": observation.band,
                "zarr_group": str(survey.store.images(product.stage)) if survey.store else "",
                "index": index,
            }
        )
    return pd.DataFrame(rows)


def table_of(rows: pd.DataFrame) -> Table:
    """Return the ObsCore table of images.

    Parameters
    ----------
    rows : DataFrame
        One row for each image, with the columns

        - obs_id, stage, index: name of the unit, name of its stage, index in the Zarr group;
        - zarr_group: path of the Zarr group;
        - calib_level: calibration level of ObsCore;
        - corners: shape (4, 2), right ascension and declination, degrees;
        - fov: diagonal of the image, degrees;
        - shape: (ny, nx);
        - pixel_scale: arcsec;
        - fwhm: FWHM of the PSF, arcsec; NaN if it is unknown;
        - t_min, t_max: start of the first and end of the last exposure, MJD;
        - t_exptime: sum of the exposure times, s;
        - em: shortest and longest wavelength, nm;
        - unit: unit of the pixel values;
        - bytes: size of the arrays;
        - survey: name of the pipeline;
        - facility: telescope and camera;
        - band.

    Returns
    -------
    Table
        Columns of `COLUMNS`, with units and UCDs.
    """
    corners = np.stack(list(rows["corners"]))
    centres = _centres(corners)
    em_min, em_max = np.array(list(rows["em"])).T * 1e-9
    shapes = np.array(list(rows["shape"]))
    facilities = list(rows["facility"])
    count = len(rows)
    columns = {
        "dataproduct_type": ["image"] * count,
        "calib_level": rows["calib_level"].to_numpy(np.int32),
        "obs_collection": list(rows["survey"]),
        "obs_id": list(rows["obs_id"]),
        "obs_publisher_did": [f"ivo://romandask/{r.survey}?{r.stage}/{r.obs_id}" for r in rows.itertuples()],
        # the fragment is the array index of the image in its Zarr group
        "access_url": [f"file://{r.zarr_group}#{r.index}" for r in rows.itertuples()],
        "access_format": ["application/vnd+zarr"] * count,
        "access_estsize": (rows["bytes"].to_numpy(np.int64) + 999) // 1000,
        "target_name": [""] * count,
        "s_ra": centres[:, 0],
        "s_dec": centres[:, 1],
        "s_fov": rows["fov"].to_numpy(float),
        "s_region": ["POLYGON ICRS " + " ".join(f"{value:.7f}" for value in polygon.ravel()) for polygon in corners],
        "s_resolution": rows["fwhm"].to_numpy(float),
        "s_xel1": shapes[:, 1].astype(np.int64),
        "s_xel2": shapes[:, 0].astype(np.int64),
        "t_min": rows["t_min"].to_numpy(float),
        "t_max": rows["t_max"].to_numpy(float),
        "t_exptime": rows["t_exptime"].to_numpy(float),
        "t_resolution": rows["t_exptime"].to_numpy(float),
        "t_xel": np.ones(count, np.int64),
        "em_min": em_min,
        "em_max": em_max,
        "em_res_power": (em_min + em_max) / 2 / (em_max - em_min),
        "em_xel": np.ones(count, np.int64),
        "o_ucd": [UCDS[unit] for unit in rows["unit"]],
        "pol_states": [""] * count,
        "pol_xel": np.zeros(count, np.int64),
        "facility_name": [telescope for telescope, _ in facilities],
        "instrument_name": [camera for _, camera in facilities],
        "s_pixel_scale": rows["pixel_scale"].to_numpy(float),
        "em_band": list(rows["band"]),
    }
    table = Table(columns)
    for name, (unit, ucd) in COLUMNS.items():
        table[name].meta["ucd"] = ucd
        if unit:
            table[name].unit = unit
    return table


def write_obscore(path: Path, rows: pd.DataFrame) -> None:
    """Write the ObsCore table of images in the format that the ending of the file names.

    Parameters
    ----------
    path : Path
        File with an ending of `ENDINGS`.
    rows : DataFrame
        As in `table_of`.
    """
    table = table_of(rows)
    with completed(path) as temporary:
        if ENDINGS[path.suffix] == "parquet":
            pd.DataFrame({name: np.asarray(table[name]) for name in table.colnames}).to_parquet(temporary)
        else:
            table.write(temporary, format=ENDINGS[path.suffix])


def _centres(corners: np.ndarray) -> np.ndarray:
    """Return the centres (n, 2) of polygons (n, k, 2) on the sphere, degrees."""
    ra, dec = np.radians(corners).transpose(2, 0, 1)
    x, y, z = np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)
    x, y, z = x.mean(axis=1), y.mean(axis=1), z.mean(axis=1)
    return np.degrees(np.stack([np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))], axis=-1))


@export_command("obscore")
def command(
    store: StoreArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File: .vot, .xml, .fits or .parquet.")],
) -> None:
    """Write a table of all stored exposures and tiles in ObsCore's columns, as archives describe observations."""
    count = export_obscore(open_survey(store), out)
    report_written([out], f"{count} images")
