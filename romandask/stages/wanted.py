"""Objects that a user wants: their ids, a table of positions, or an area on the sky, looked up in tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.products.tables import TableProduct

Wanted = Sequence[int] | np.ndarray | pd.DataFrame | Region | Cone
"""Selection of objects: their ids, a table with the columns id, ra and dec (degrees), or an area on the sky."""


@dataclass(frozen=True)
class Positions:
    """A table of objects, and the names of its columns with ids and positions."""

    product: TableProduct
    """The table."""
    id: str
    """Column of the id."""
    ra: str
    """Column of the right ascension, degrees."""
    dec: str
    """Column of the declination, degrees."""

    def named(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Return the three columns of rows of the table, renamed to id, ra and dec."""
        return rows[[self.id, self.ra, self.dec]].set_axis(["id", "ra", "dec"], axis=1)


def located(of: Wanted, tables: Sequence[Positions], catalog: str) -> pd.DataFrame:
    """Return id, ra and dec of selected objects.

    Parameters
    ----------
    of : Wanted
        Selection of objects.
    tables : sequence of Positions
        Tables in which ids and areas on the sky are looked up.
    catalog : str
        Name of the tables in error messages.

    Returns
    -------
    DataFrame
        One row per object, in the order of the ids (without repetitions), or in the order of the tables.

    Raises
    ------
    UserError
        If an id is in none of the tables, ids are not integers, or a column of a given table is missing.
    """
    if isinstance(of, pd.DataFrame):
        missing = sorted({"id", "ra", "dec"} - set(of.columns))
        if missing:
            raise UserError(f"table of objects: columns {', '.join(missing)} are missing")
        return of[["id", "ra", "dec"]].reset_index(drop=True)
    if isinstance(of, Region | Cone):
        parts = [table.named(table.product.rows_within(of, table.ra, table.dec)) for table in tables]
        return pd.concat(parts, ignore_index=True)
    ids = np.asarray(of).ravel()
    if ids.size and ids.dtype.kind not in "iu":
        raise UserError(f"ids of objects are whole numbers, found {ids.dtype}")
    ids = pd.unique(ids.astype(np.int64))
    columns = [[table.id, table.ra, table.dec] for table in tables]
    parts = [t.named(t.product.rows_where(t.id, ids, names)) for t, names in zip(tables, columns, strict=True)]
    rows = pd.concat(parts, ignore_index=True)
    absent = np.setdiff1d(ids, rows["id"])
    if len(absent):
        raise UserError(f"{len(absent)} of {len(ids)} ids are not in {catalog}, the first is {absent[0]}")
    rank = pd.Series(np.arange(len(ids)), index=ids).loc[rows["id"]].to_numpy()
    return rows.iloc[np.argsort(rank, kind="stable")].reset_index(drop=True)
