"""Binary tables of FITS files: which one is meant, the types and units of its columns, and its rows in slices."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from astropy.io import fits

from romandask.ingest.identifiers import Identifiers, check_floats, identifiers
from romandask.ingest.rows import MAX_ROWS
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

LDAC = "LDAC_OBJECTS"
"""Name of the table of objects in a FITS_LDAC file of Source Extractor; its other tables hold headers."""


@dataclass(frozen=True)
class FitsTable:
    """A binary table of a FITS file."""

    path: AnyPath
    """The file."""
    hdu: int
    """Number of the HDU."""
    rows: int
    """Number of rows."""
    kinds: dict[str, str]
    """What each column holds: number or text, or something else that a message can name."""
    units: dict[str, str]
    """Unit of each column that has one (TUNIT)."""

    def check_identifiers(self, column: str) -> None:
        """Raise a UserError if the column holds floats that cannot be identifiers."""
        with _opened(self.path) as hdus:
            for start in range(0, self.rows, MAX_ROWS):
                values, missing = _values(hdus[self.hdu], column, start, start + MAX_ROWS)
                if values.dtype.kind != "f":
                    return
                check_floats(self.path, column, values[~missing])

    def read(self, columns: dict[str, str], texts: tuple[str, ...], start: int, stop: int) -> dict[str, np.ndarray]:
        """Return rows as numbers (NaN where a value is missing) or texts, by the keys of `columns`.

        Parameters
        ----------
        columns : dict
            Columns of the file, by any key.
        texts : tuple of str
            Keys of the columns that hold texts.
        start, stop : int
            First row, and end of the rows, exclusive.
        """
        out = {}
        with _opened(self.path) as hdus:
            for key, column in columns.items():
                values, missing = _values(hdus[self.hdu], column, start, stop)
                out[key] = _texts(values) if key in texts else np.where(missing, np.nan, values.astype(float))
        return out

    def identifiers(self, column: str, start: int, stop: int) -> Identifiers:
        """Return the identifiers of rows."""
        with _opened(self.path) as hdus:
            values, missing = _values(hdus[self.hdu], column, start, stop)
        return identifiers(_texts(values) if values.dtype.kind in "SU" else values, missing=missing)


def open_table(path: AnyPath, wanted: set[str]) -> FitsTable:
    """Return the table of a FITS file that holds the wanted columns.

    Raises
    ------
    UserError
        If the file is not complete, has no binary table, or has several that could be meant. Of several tables that
        all lack columns, the one with most of them is returned.
    """
    try:
        with _opened(path) as hdus:
            tables = {number: hdu for number, hdu in enumerate(hdus) if isinstance(hdu, fits.BinTableHDU)}
            objects = [number for number, hdu in tables.items() if hdu.name == LDAC]
            names = {number: hdu.name for number, hdu in tables.items()}
            matching = {number: len(wanted & set(hdu.columns.names)) for number, hdu in tables.items()}
            most = max(matching.values(), default=0)
            meant = objects or [number for number, count in matching.items() if count == most]
            if len(meant) > 1 and (objects or most == len(wanted)):
                listed = ", ".join(f"HDU {number} {names[number]}".rstrip() for number in meant)
                raise UserError(
                    f"{path}: holds {len(meant)} tables with the columns of the map ({listed}): copy one to a file of "
                    "its own"
                )
            if not meant:
                found = ", ".join(type(hdu).__name__ for hdu in hdus)
                raise UserError(f"{path}: holds no binary table (found {found})")
            hdu = tables[meant[0]]
            end = hdu.fileinfo()["datLoc"] + hdu.header["NAXIS1"] * hdu.header["NAXIS2"]
            size = path.stat().st_size
            if size < end:
                raise UserError(f"{path}: not a complete FITS file ({size} bytes of {end}): copy it again")
            units = {column.name: column.unit for column in hdu.columns if column.unit}
            kinds = {column.name: _kind(hdu, column) for column in hdu.columns}
            return FitsTable(path, meant[0], int(hdu.header["NAXIS2"]), kinds, units)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a complete FITS file ({error}): copy it again") from None


@contextmanager
def _opened(path: AnyPath) -> Iterator[fits.HDUList]:
    with warnings.catch_warnings():
        # astropy only warns of a truncated file, which `open_table` refuses
        warnings.simplefilter("ignore")
        with fits.open(local_copy(path), memmap=True) as hdus:
            yield hdus


def _kind(hdu: fits.BinTableHDU, column: fits.Column) -> str:
    """Return number, text, or what else a column holds."""
    stored = hdu.columns.dtype[column.name]
    letter = column.format.lstrip("0123456789")[:1]
    if letter in "PQ":
        return "lists of any length"
    if letter == "A":
        # TDIM of a column of texts is the length of a text, and then the shape
        sizes = str(column.dim or "").strip("() ").split(",")[1:]
        return "arrays of texts" if any(int(size) != 1 for size in sizes) else "text"
    if letter not in "BIJKED":
        return {"L": "truth values", "X": "bits"}.get(letter, "complex numbers")
    shape = stored.shape or (1,)
    return "number" if np.prod(shape) == 1 else f"arrays of {' x '.join(map(str, shape))} numbers"


def _values(hdu: fits.BinTableHDU, column: str, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of a column, in native byte order and one-dimensional, and where they are missing (TNULL)."""
    rows = hdu.data[start:stop]
    values = np.asarray(rows[column])
    count = len(values)
    null = hdu.columns[column].null
    missing = np.zeros(count, bool)
    if null not in (None, ""):
        # TNULL is a value as stored, before TSCAL and TZERO
        missing = (rows.view(np.ndarray)[column].reshape(count, -1) == null).all(axis=1)
    values = values.reshape(count)
    if values.dtype.kind not in "SU":
        values = np.array(values.astype(values.dtype.newbyteorder("=")))
    return values, missing


def _texts(values: np.ndarray) -> np.ndarray:
    """Return texts without surrounding blanks."""
    return np.array([text.strip() for text in values.astype(str).tolist()], object)
