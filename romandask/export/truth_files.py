"""The truth for those who read FITS and HDF5: tables of galaxies and stars a partition at a time, and the spectra."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
from astropy.io import fits

from romandask.model.spectra import SpectrumLibrary

BLOCK = 2880
"""FITS files come in blocks of this many bytes."""


def write_fits(path: Path, schema: pa.Schema, parts: Iterable[pd.DataFrame], rows: int, bins: int) -> None:
    """Write a table as the first extension of a FITS file, however large: one part is in memory at a time.

    Parameters
    ----------
    rows : of all parts together
    bins : length of list columns; they are left out where it is 0

    Units and descriptions become TUNIT and comments. Text columns are not part of truth catalogs.

    Raises
    ------
    ValueError
        If the parts hold another number of rows.
    """
    columns = [field for field in schema if bins or not pa.types.is_list(field.type)]
    kinds = np.dtype([_kind(field, bins) for field in columns])
    header = fits.BinTableHDU(np.zeros(0, kinds)).header
    header["NAXIS2"] = rows
    for number, field in enumerate(columns, start=1):
        metadata = field.metadata or {}
        if unit := metadata.get(b"unit", b"").decode():
            header[f"TUNIT{number}"] = unit
        header.comments[f"TTYPE{number}"] = metadata.get(b"description", b"").decode("ascii", "replace")[:40]
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    written = 0
    try:
        with open(temporary, "wb") as file:
            file.write(fits.PrimaryHDU().header.tostring().encode())
            file.write(header.tostring().encode())
            for part in parts:
                file.write(_records(part, columns, kinds).tobytes())
                written += len(part)
            file.write(b"\0" * (-(written * kinds.itemsize) % BLOCK))
        if written != rows:
            raise ValueError(f"{path}: {written} rows, expected {rows}")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_spectra(path: Path, library: SpectrumLibrary, edges: tuple[float, ...]) -> None:
    """Write a library as HDF5: wave (nm), flambda (spectrum, wave; 1 at 500 nm), names, edges of bins (nm)."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with h5py.File(temporary, "w") as file:
            file["wave"] = library.wave
            file["wave"].attrs["unit"] = "nm"
            file.create_dataset(
                "flambda", data=library.photons * (500.0 / library.wave), compression="gzip", fletcher32=True
            )
            file["flambda"].attrs["description"] = "rest-frame f_lambda over that at 500 nm; rows as *_sed number them"
            file["name"] = np.array(library.names, dtype=h5py.string_dtype())
            if edges:
                file["tophat_edges"] = np.array(edges)
                file["tophat_edges"].attrs["unit"] = "nm"
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _kind(field: pa.Field, bins: int) -> tuple:
    if pa.types.is_list(field.type):
        return (field.name, ">f4", (bins,))
    kind = np.dtype(field.type.to_pandas_dtype())
    return (field.name, kind.newbyteorder(">"))


def _records(part: pd.DataFrame, columns: list[pa.Field], kinds: np.dtype) -> np.ndarray:
    out = np.zeros(len(part), kinds)
    for field in columns:
        values = part[field.name].to_numpy()
        if pa.types.is_list(field.type):
            length = kinds[field.name].shape[0]
            values = np.stack([row if len(row) else np.zeros(length, np.float32) for row in values]) if len(part) else 0
        if pa.types.is_boolean(field.type):
            # FITS has letters for truth values
            out[field.name] = False
            out[field.name].view("i1")[:] = np.where(values, ord("T"), ord("F"))
        else:
            out[field.name] = values
    return out
