"""Truth catalogs: galaxies and stars as FITS tables, written a partition at a time, and their spectra as HDF5."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
from astropy.io import fits

from romandask.export.command import export_command, report_written
from romandask.export.files import completed, make_folder
from romandask.export.options import Folder, StoreArgument
from romandask.model.errors import UserError
from romandask.model.spectra import SpectrumLibrary
from romandask.products.tables import TableProduct
from romandask.survey import Survey, open_survey

BLOCK_BYTES = 2880
"""A FITS file is a sequence of blocks of this size."""


def export_truth(survey: Survey, folder: Path) -> list[Path]:
    """Write the truth of a stored survey as galaxies.fits, stars.fits and seds.hdf5.

    The tables have the names of spectra as well as their numbers, so that `romandask ingest table` reads them again,
    with seds.hdf5 as the spectra.

    Parameters
    ----------
    survey : Survey
        Stored survey.
    folder : Path
        Folder of the files.

    Returns
    -------
    list of Path
        Written files.

    Raises
    ------
    UserError
        If a unit of the truth is missing, or the folder cannot be created.
    """
    catalogs = survey.truth_catalogs
    for product in (catalogs.galaxies, catalogs.stars):
        missing = [name for index, name in enumerate(product.names) if not product.has(index)]
        if missing:
            raise UserError(
                f"{product.stage} is not all there: {len(missing)} of {len(product.names)} units are missing, first "
                f"{missing[0]}; run the survey first"
            )
    make_folder(folder)
    n_bins = max(len(catalogs.edges) - 1, 0)
    written = []
    for product in (catalogs.galaxies, catalogs.stars):
        path = folder / f"{product.stage.split('/')[1]}.fits"
        named, length = _with_names(product.schema), max([1, *map(len, catalogs.library.names)])
        parts = (_with_names_of(part, catalogs.library) for part in _partitions(product))
        write_table(path, named, parts, len(product.column("ra")), n_bins, length)
        written.append(path)
    path = folder / "seds.hdf5"
    write_spectra(path, catalogs.library, catalogs.edges)
    return [*written, path]


def _partitions(product: TableProduct) -> Iterator[pd.DataFrame]:
    for index in range(len(product.names)):
        yield product.load(index)


def _with_names(schema: pa.Schema) -> pa.Schema:
    """Return the schema with the name of each spectrum (<column>_name) after its number."""
    fields = []
    for field in schema:
        fields.append(field)
        if field.name == "sed" or field.name.endswith("_sed"):
            fields.append(pa.field(f"{field.name}_name", pa.string(), metadata={"description": "Name of the spectrum"}))
    return pa.schema(fields)


def _with_names_of(part: pd.DataFrame, library: SpectrumLibrary) -> pd.DataFrame:
    """Return rows with the names of their spectra, "" for -1."""
    # the last one is found by -1
    names = np.array([*library.names, ""], object)
    columns = [name for name in part.columns if name == "sed" or name.endswith("_sed")]
    return part.assign(**{f"{name}_name": names[part[name].to_numpy(int)] for name in columns})


def write_table(
    path: Path, schema: pa.Schema, parts: Iterable[pd.DataFrame], n_rows: int, n_bins: int, text_length: int = 1
) -> None:
    """Write a table as the first extension of a FITS file; one part is in memory at a time.

    Units become TUNIT cards and descriptions become comments.

    Parameters
    ----------
    path : Path
        FITS file.
    schema : pyarrow.Schema
        Columns, with the metadata `unit` and `description`.
    parts : iterable of DataFrame
        Rows of the table, in order.
    n_rows : int
        Number of rows of all parts.
    n_bins : int
        Length of the values of list columns; the file has no list columns if it is 0.
    text_length : int
        Length of the values of text columns, which are ASCII.

    Raises
    ------
    ValueError
        If the parts do not have `n_rows` rows.
    """
    columns = [field for field in schema if n_bins or not pa.types.is_list(field.type)]
    dtype = np.dtype([_column_dtype(field, n_bins, text_length) for field in columns])
    header = fits.BinTableHDU(np.zeros(0, dtype)).header
    header["NAXIS2"] = n_rows
    for number, field in enumerate(columns, start=1):
        metadata = field.metadata or {}
        if unit := metadata.get(b"unit", b"").decode():
            header[f"TUNIT{number}"] = unit
        header.comments[f"TTYPE{number}"] = metadata.get(b"description", b"").decode("ascii", "replace")[:40]
    written = 0
    with completed(path) as temporary:
        with open(temporary, "wb") as file:
            file.write(fits.PrimaryHDU().header.tostring().encode())
            file.write(header.tostring().encode())
            for part in parts:
                file.write(_records(part, columns, dtype).tobytes())
                written += len(part)
            file.write(b"\0" * (-(written * dtype.itemsize) % BLOCK_BYTES))
        if written != n_rows:
            raise ValueError(f"{path}: {written} rows, expected {n_rows}")


def write_spectra(path: Path, library: SpectrumLibrary, edges: tuple[float, ...]) -> None:
    """Write a spectrum library as HDF5.

    The file has the data sets wave (nm), flambda (spectrum, wave; 1 at 500 nm), name, limits (spectrum, 2; shortest and
    longest wavelength, nm), and tophat_edges (nm) if there are top-hat spectra.

    Parameters
    ----------
    path : Path
        HDF5 file.
    library : SpectrumLibrary
        Rest-frame spectra.
    edges : tuple of float, nm
        Edges of the top-hat bins; empty if no galaxy has a top-hat spectrum.
    """
    with completed(path) as temporary, h5py.File(temporary, "w") as file:
        file["wave"] = library.wave
        file["wave"].attrs["unit"] = "nm"
        file.create_dataset(
            "flambda", data=library.photons * (500.0 / library.wave), compression="gzip", fletcher32=True
        )
        file["flambda"].attrs["description"] = "rest-frame f_lambda over that at 500 nm; rows as *_sed number them"
        file["name"] = np.array(library.names, dtype=h5py.string_dtype())
        file["limits"] = library.limits
        file["limits"].attrs["unit"] = "nm"
        if edges:
            file["tophat_edges"] = np.array(edges)
            file["tophat_edges"].attrs["unit"] = "nm"


def _column_dtype(field: pa.Field, n_bins: int, text_length: int) -> tuple[Any, ...]:
    """Return the big-endian entry of a column in a structured dtype."""
    if pa.types.is_string(field.type):
        return (field.name, f"S{text_length}")
    if pa.types.is_list(field.type):
        return (field.name, ">f4", (n_bins,))
    dtype = np.dtype(field.type.to_pandas_dtype())
    return (field.name, dtype.newbyteorder(">"))


def _records(part: pd.DataFrame, columns: list[pa.Field], dtype: np.dtype) -> np.ndarray:
    """Return rows as the records of a FITS table."""
    records = np.zeros(len(part), dtype)
    for field in columns:
        values = part[field.name].to_numpy()
        if pa.types.is_list(field.type) and len(part):
            length = dtype[field.name].shape[0]
            values = np.stack([row if len(row) else np.zeros(length, np.float32) for row in values])
        if pa.types.is_boolean(field.type):
            # FITS stores truth values as the letters T and F
            records[field.name].view("i1")[:] = np.where(values, ord("T"), ord("F"))
        elif len(part):
            records[field.name] = values.astype(bytes) if pa.types.is_string(field.type) else values
    return records


@export_command("truth")
def command(store: StoreArgument, out: Folder) -> None:
    """Write the truth as galaxies.fits and stars.fits, and its spectra as seds.hdf5."""
    report_written(export_truth(open_survey(store), out))
