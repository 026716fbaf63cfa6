"""One pass over all ingested rows: the cells and spectra that they need, and identifiers that occur more than once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.ingest.identifiers import repeated_values
from romandask.products.tables import TableProduct

SPECTRA = ("bulge_sed", "disk_sed", "knots_sed", "sed")
"""Columns with the names of spectra."""
KINDS = ("galaxy", "star")


@dataclass(frozen=True, kw_only=True)
class RowsSummary:
    """What is known only from all ingested rows together."""

    cells: np.ndarray
    """HEALPix cells with good rows, sorted."""
    spectra: tuple[str, ...]
    """Names of the spectra of good rows, sorted."""
    duplicates: dict[int, np.ndarray]
    """Rows whose identifier occurs in an earlier row: values of the column `row`, by unit."""
    strays: pd.DataFrame
    """Components of galaxies that lie in another cell than the first row of their galaxy: `unit`, `row`, `_healpix_29`
    and `home`, the cell of that first row."""


def scan_rows(rows: TableProduct, order: int, components: tuple[bool, ...]) -> RowsSummary:
    """Return the summary of all ingested rows.

    Batches are read one at a time. Identifiers are unique among the galaxies, and among the stars, of all files: the
    first row, in the order of the files, has the identifier, and later rows are duplicates. In catalogs of components,
    rows of galaxies with the same identifier are components of one galaxy.

    Parameters
    ----------
    rows : TableProduct
        Ingested rows.
    order : int
        Order of the HEALPix cells.
    components : tuple of bool
        Whether the rows of galaxies of each unit are components.
    """
    cells: set[int] = set()
    names: set[str] = set()
    ids: dict[str, list[np.ndarray]] = {kind: [] for kind in KINDS}
    for index in range(len(rows.units)):
        frame = rows.select(index, ["_healpix_29", "reason", "kind", "id", *SPECTRA])
        for kind in KINDS:
            ids[kind].append(frame.loc[frame["kind"] == kind, "id"].to_numpy())
        frame = frame[frame["reason"] == ""]
        cells |= set(np.unique(frame["_healpix_29"].to_numpy() >> (2 * (29 - order))).tolist())
        for column in SPECTRA:
            names |= set(frame[column].unique().tolist())
    repeated = {kind: repeated_values(parts) for kind, parts in ids.items()}
    found = _rows_with(rows, repeated)
    of_components = np.array(components, bool)[found["unit"].to_numpy(int)] & (found["kind"] == "galaxy")
    whole = found[~of_components]
    later = whole[whole.duplicated(["kind", "id"])]
    return RowsSummary(
        cells=np.array(sorted(cells), np.int64),
        spectra=tuple(sorted(names - {""})),
        duplicates={int(unit): part["row"].to_numpy() for unit, part in later.groupby("unit")},
        strays=_strays(found[of_components & (found["reason"] == "")], order),
    )


def _rows_with(rows: TableProduct, repeated: dict[str, np.ndarray]) -> pd.DataFrame:
    """Return the rows with the given identifiers, by kind, in the order of the files."""
    columns = ["_healpix_29", "reason", "kind", "id", "row"]
    parts = [rows.empty()[columns].assign(unit=np.empty(0, np.int64))]
    for index in range(len(rows.units)) if any(map(len, repeated.values())) else ():
        frame = rows.select(index, columns)
        chosen = np.zeros(len(frame), bool)
        for kind, values in repeated.items():
            chosen |= (frame["kind"] == kind).to_numpy() & np.isin(frame["id"].to_numpy(), values)
        if chosen.any():
            parts.append(frame[chosen].assign(unit=np.int64(index)))
    return pd.concat(parts[1:] or parts, ignore_index=True).sort_values(["unit", "row"], ignore_index=True)


def _strays(components: pd.DataFrame, order: int) -> pd.DataFrame:
    """Return the components, given in the order of the files, that lie in another cell than the first of their id."""
    cell = components["_healpix_29"].to_numpy(np.int64) >> (2 * (29 - order))
    home = pd.Series(cell).groupby(components["id"].to_numpy(np.int64)).transform("first").to_numpy()
    return components.assign(home=home).loc[cell != home, ["unit", "row", "_healpix_29", "home"]]
