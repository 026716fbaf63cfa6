"""Multi-epoch cutouts of objects (MEDS), one FITS file for each band; the cutouts of one image at a time are in memory.

The tables follow https://github.com/esheldon/meds/wiki/MEDS-Format. The sky frame of the Jacobians is that of GalSim (u
to the west, v to the north), as in `galsim.des.WriteMEDS`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
import xarray as xr
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import Bands, Folder, StoreArgument
from romandask.model.errors import UserError
from romandask.model.sky import Cone
from romandask.stages.wanted import Wanted, located
from romandask.survey import Survey, open_survey

EMPTY = -9999
"""Value of table entries for cutouts that an object does not have."""
_FIELDS = {
    "file_id": "K",
    "start_row": "K",
    "orig_row": "D",
    "orig_col": "D",
    "orig_start_row": "K",
    "orig_start_col": "K",
    "cutout_row": "D",
    "cutout_col": "D",
    "dudrow": "D",
    "dudcol": "D",
    "dvdrow": "D",
    "dvdcol": "D",
    "psf_start_row": "K",
    "psf_cutout_row": "D",
    "psf_cutout_col": "D",
}
"""Columns of object_data with one value for each cutout, and their FITS format codes."""
_PLANES = {"image_cutouts": ">f4", "weight_cutouts": ">f4", "bmask_cutouts": ">i4", "psf": ">f4"}
"""Extensions with pixels, and their dtypes."""


@dataclass(frozen=True)
class Catalog:
    """Content of the tables of a MEDS file."""

    objects: pd.DataFrame
    """One row for each object: id, ra, dec (degrees)."""
    cutouts: pd.DataFrame
    """One row for each cutout: object (row of `objects`), image (row of `images`), x and y (pixel coordinates of the
    object on the image, 0 at the centre of the first pixel), column and row (first pixel of the cutout on the image),
    dudx, dudy, dvdx, dvdy (arcsec a pixel)."""
    images: pd.DataFrame
    """One row for each image: name, magzp (AB magnitude of one electron)."""
    size: int
    """Side of the cutouts and of their PSFs, pixels."""


def export_meds(
    survey: Survey, folder: Path, wanted: Wanted, bands: Sequence[str], size: int, catalog: str
) -> list[Path]:
    """Write cutouts of objects from all exposures of the sharpest survey, one MEDS file for each band.

    Images are in electrons, without the expected background. Objects that no exposure of a band covers have no cutouts.

    Parameters
    ----------
    survey : Survey
        Survey, stored or not. The exposures are those of `survey.sharpest`.
    folder : Path
        Folder of the files.
    wanted : sequence of int, DataFrame, Region or Cone
        Objects: their ids, a table with columns id, ra, dec (degrees), or a part of the sky.
    bands : sequence of str
        Bands; all bands of the survey if empty.
    size : int
        Side of the cutouts, pixels; even.
    catalog : str
        Catalog of the objects: `truth`, or the name of a survey for its detected objects.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If an id, a band or the catalog does not exist, the size is not possible, or the folder cannot be created.
    """
    objects = located(wanted, survey.tables(catalog), catalog)
    instrument = survey.instruments[survey.sharpest]
    layers = ("image", "background", "weight", "dq", "psf")
    cutouts = {band: survey.cutouts(objects, layers, (band,), size) for band in bands or instrument.bands}
    make_folder(folder)
    names = survey.output(f"exposures/{survey.sharpest}").names
    exposure_times = dict(zip(names, survey.pointings(survey.sharpest)["exptime"], strict=True))
    written = []
    for band, dataset in cutouts.items():
        units, image = np.unique(dataset["unit"].to_numpy(), return_inverse=True)
        seconds = np.array([exposure_times[name] for name in units])
        zero_points = 2.5 * np.log10(instrument.bandpass(band).ab_photons() * seconds)
        jacobian = dataset["jacobian"].to_numpy()
        columns = {name: dataset[name].to_numpy() for name in ("object", "column", "row")}
        columns |= {name: dataset[f"{name}_image"].to_numpy() for name in ("x", "y")}
        columns |= {name: jacobian[:, k // 2, k % 2] for k, name in enumerate(("dudx", "dudy", "dvdx", "dvdy"))}
        tables = Catalog(
            objects,
            pd.DataFrame(columns | {"image": image}),
            pd.DataFrame({"name": units, "magzp": zero_points}),
            size,
        )
        path = folder / f"meds-{band}.fits"
        write_meds(path, tables, _parts(dataset))
        written.append(path)
    return written


def _parts(dataset: xr.Dataset) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Yield the planes of the cutouts of one exposure after another."""
    stop = 0
    for count in dataset["image"].chunksizes["cutout"] if dataset.sizes["cutout"] else ():
        rows, stop = slice(stop, stop + count), stop + count
        part = dataset.isel(cutout=rows).load()
        planes = {name: part[name].to_numpy() for name in ("weight", "dq", "psf")}
        # beyond the edge of an image both terms are 0
        yield rows, planes | {"image": (part["image"] - part["background"]).to_numpy()}


def write_meds(path: Path, catalog: Catalog, parts: Iterable[tuple[slice, Mapping[str, np.ndarray]]]) -> None:
    """Write a MEDS file.

    Parameters
    ----------
    path : Path
        FITS file. It appears under its name when it is complete.
    catalog : Catalog
        Content of the tables.
    parts : iterable of (slice, mapping)
        Rows of `catalog.cutouts` with their planes image, weight, dq and psf, shape (n, size, size); every row once.
    """
    order = np.lexsort((catalog.cutouts["image"], catalog.cutouts["object"]))
    # position of each cutout in the file
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    with completed(path) as temporary:
        offsets = _write_headers(temporary, _tables(catalog, order), len(order) * catalog.size**2)
        shape = (len(order), catalog.size, catalog.size)
        # a memory map cannot be empty
        extensions = _PLANES if len(order) else {}
        planes = {n: np.memmap(temporary, dtype, "r+", offsets[n], shape) for n, dtype in extensions.items()}
        for rows, values in parts:
            for name, layer in zip(_PLANES, ("image", "weight", "dq", "psf"), strict=True):
                planes[name][rank[rows]] = values[layer]
        for plane in planes.values():
            plane.flush()


def _tables(catalog: Catalog, order: np.ndarray) -> list[fits.BinTableHDU]:
    """Return the tables object_data, image_info and metadata, with the cutouts in the order of the file."""
    objects, cutouts, size = catalog.objects, catalog.cutouts.iloc[order], catalog.size
    owner = cutouts["object"].to_numpy()
    count = np.bincount(owner, minlength=len(objects))
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    start = np.arange(len(owner)) * size**2
    middle = np.full(len(owner), size // 2)
    values = {
        "file_id": cutouts["image"],
        "start_row": start,
        "orig_row": cutouts["y"],
        "orig_col": cutouts["x"],
        "orig_start_row": cutouts["row"],
        "orig_start_col": cutouts["column"],
        "cutout_row": cutouts["y"] - cutouts["row"],
        "cutout_col": cutouts["x"] - cutouts["column"],
        "dudrow": cutouts["dudy"],
        "dudcol": cutouts["dudx"],
        "dvdrow": cutouts["dvdy"],
        "dvdcol": cutouts["dvdx"],
        "psf_start_row": start,
        "psf_cutout_row": middle,
        "psf_cutout_col": middle,
    }
    # MEDS readers take a column with one value a row for a scalar
    width = max(int(count.max(initial=0)), 2)
    columns = [
        fits.Column("id", "K", array=objects["id"].to_numpy()),
        fits.Column("number", "K", array=np.arange(1, len(objects) + 1)),
        fits.Column("ra", "D", array=objects["ra"].to_numpy(float)),
        fits.Column("dec", "D", array=objects["dec"].to_numpy(float)),
        fits.Column("box_size", "K", array=np.full(len(objects), size)),
        fits.Column("psf_box_size", "K", array=np.full(len(objects), size)),
        fits.Column("ncutout", "K", array=count),
    ]
    for name, code in _FIELDS.items():
        table = np.full((len(objects), width), EMPTY, np.int64 if code == "K" else np.float64)
        table[owner, number] = np.asarray(values[name])
        columns.append(fits.Column(name, f"{width}{code}", array=table))
    images = catalog.images
    names = np.array([*images["name"]], "S")
    blank = np.zeros(len(images), np.int64)
    info = [
        fits.Column("image_path", f"{max(names.itemsize, 1)}A", array=names),
        fits.Column("image_ext", "I", array=blank),
        fits.Column("image_id", "K", array=np.arange(len(images))),
        fits.Column("image_flags", "K", array=blank),
        fits.Column("magzp", "D", array=images["magzp"].to_numpy(float)),
        fits.Column("scale", "D", array=np.ones(len(images))),
        fits.Column("position_offset", "D", array=blank),
    ]
    zero = float(images["magzp"].median()) if len(images) else 0.0
    metadata = [fits.Column("magzp_ref", "D", array=[zero]), fits.Column("min_boxsize", "K", array=[size])]
    return [
        fits.BinTableHDU.from_columns(columns, name="object_data"),
        fits.BinTableHDU.from_columns(info, name="image_info"),
        fits.BinTableHDU.from_columns(metadata, name="metadata"),
    ]


def _write_headers(path: Path, tables: list[fits.BinTableHDU], n_pixels: int) -> dict[str, int]:
    """Write the tables and the headers of the extensions with pixels.

    Returns
    -------
    dict of str to int
        Offset of the pixels of each extension in the file, bytes.
    """
    fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(path)
    offsets = {}
    with open(path, "r+b") as file:
        for name, dtype in _PLANES.items():
            file.seek(0, os.SEEK_END)
            header = fits.Header()
            header["XTENSION"] = "IMAGE"
            header["BITPIX"] = -32 if dtype == ">f4" else 32
            header["NAXIS"], header["NAXIS1"] = 1, n_pixels
            header["PCOUNT"], header["GCOUNT"] = 0, 1
            header["EXTNAME"] = name
            file.write(header.tostring().encode())
            offsets[name] = file.tell()
            # a FITS file has blocks of 2880 bytes; the zeros take no disk space until pixels are written
            file.truncate(offsets[name] + -(-n_pixels * 4 // 2880) * 2880)
    return offsets


@export_command("meds")
def command(
    store: StoreArgument,
    out: Folder,
    ids: Annotated[list[int] | None, typer.Option("--id", help="Id of an object; may be repeated.")] = None,
    cone: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--cone", metavar="RA DEC RADIUS", help="All objects there: degrees, degrees, arcsec."),
    ] = None,
    band: Bands = None,
    size: Annotated[int, typer.Option("--size", help="Pixels a side, even.")] = 48,
    catalog: Annotated[str, typer.Option("--catalog", help="Whose objects: truth, roman or rubin.")] = "truth",
) -> None:
    """Write cutouts of objects from all Roman exposures that see them, with WCS and PSF: a MEDS file for each band."""
    if (ids is None) == (cone is None):
        raise UserError("export meds needs --id (one or more) or --cone, not both")
    wanted = Cone(*cone) if cone is not None else ids or []
    report_written(export_meds(open_survey(store), out, wanted, band or [], size, catalog))
