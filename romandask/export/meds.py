"""MEDS: multi-epoch cutouts of objects in one FITS file, filled image by image, so that no list of them is in memory.

The tables are those of https://github.com/esheldon/meds/wiki/MEDS-Format; the sky frame of the Jacobians is GalSim's
(u to the west, v to the north), as in `galsim.des.WriteMEDS`.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.io import fits

EMPTY = -9999
"""What the tables hold where an object has fewer cutouts than others."""
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
_PLANES = {"image_cutouts": ">f4", "weight_cutouts": ">f4", "bmask_cutouts": ">i4", "psf": ">f4"}
"""Extensions of pixels."""


@dataclass(frozen=True)
class Catalog:
    """What the tables of a file say of its cutouts."""

    objects: pd.DataFrame
    """One row an object: id, ra, dec (degrees)."""
    cutouts: pd.DataFrame
    """One row a cutout: object (row of `objects`), image (row of `images`), x, y (pixel coordinate on the image, 0 at
    the centre of the first pixel), column, row (of its first pixel), dudx, dudy, dvdx, dvdy (arcsec a pixel)."""
    images: pd.DataFrame
    """One row an image: name, magzp."""
    size: int
    """Pixels a side of every cutout, and of its PSF."""


def write(path: Path, catalog: Catalog, parts: Iterable[tuple[slice, Mapping[str, np.ndarray]]]) -> None:
    """Write a MEDS file.

    Parameters
    ----------
    parts : some rows of `catalog.cutouts` at a time with their planes (n, size, size): image, weight, dq, psf
    """
    order = np.lexsort((catalog.cutouts["image"], catalog.cutouts["object"]))
    # where in the file's order each cutout is
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        offsets = _prepare(temporary, _tables(catalog, order), len(order) * catalog.size**2)
        shape = (len(order), catalog.size, catalog.size)
        planes = {
            name: np.memmap(temporary, kind, "r+", offsets[name], shape) for name, kind in _PLANES.items() if len(order)
        }
        for rows, values in parts:
            for name, layer in zip(_PLANES, ("image", "weight", "dq", "psf"), strict=True):
                planes[name][place[rows]] = values[layer]
        for plane in planes.values():
            plane.flush()
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _tables(catalog: Catalog, order: np.ndarray) -> list[fits.BinTableHDU]:
    """Return object_data, image_info and metadata."""
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
    # MEDS readers take a column of one value for a scalar
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
    for name, kind in _FIELDS.items():
        table = np.full((len(objects), width), EMPTY, np.int64 if kind == "K" else np.float64)
        table[owner, number] = np.asarray(values[name])
        columns.append(fits.Column(name, f"{width}{kind}", array=table))
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


def _prepare(path: Path, tables: list[fits.BinTableHDU], pixels: int) -> dict[str, int]:
    """Write the tables and the headers of the pixels, and return where the pixels of each extension begin, bytes."""
    fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(path)
    offsets = {}
    with open(path, "r+b") as file:
        for name, kind in _PLANES.items():
            file.seek(0, os.SEEK_END)
            header = fits.Header()
            header["XTENSION"] = "IMAGE"
            header["BITPIX"] = -32 if kind == ">f4" else 32
            header["NAXIS"], header["NAXIS1"] = 1, pixels
            header["PCOUNT"], header["GCOUNT"] = 0, 1
            header["EXTNAME"] = name
            file.write(header.tostring().encode())
            offsets[name] = file.tell()
            # blocks of 2880 bytes, zeros that take no disk until they are filled
            file.truncate(offsets[name] + -(-pixels * 4 // 2880) * 2880)
    return offsets
