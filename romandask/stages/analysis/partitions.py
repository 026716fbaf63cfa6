"""Common HEALPix partitions of the objects of several catalogs, which friends of friends works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.products.hats import RIM_ORDER, rim
from romandask.products.tables import TableProduct

CODES = 8
"""The key of an object is CODES * objectId + code of its survey; codes are smaller than CODES."""


@dataclass(frozen=True, kw_only=True)
class Partitions:
    """The objects of several catalogs, divided into common HEALPix partitions."""

    objects: dict[str, TableProduct]
    """Catalogs by survey."""
    codes: dict[str, int]
    """Number of each survey, part of the keys."""
    longest: float
    """Longest linking length, arcsec."""
    order: int
    """HEALPix order of the partitions."""
    cells: tuple[int, ...]
    """Nested HEALPix cells of the partitions."""
    shift: dict[str, float]
    """Distance in declination by which a survey is shifted, arcsec."""

    def inputs(self, cell: int, with_ring: bool = False) -> tuple[tuple[str, str], ...]:
        """Return the units with the objects of a cell and, if wanted, of the ring of cells around it."""
        return tuple(
            (product.stage, product.names[k])
            for product in self.objects.values()
            for k in sorted(
                {
                    *product.touching_cells(np.array([cell]), self.order),
                    *(product.touching_cells(rim(cell, self.order), RIM_ORDER) if with_ring else ()),
                }
            )
        )

    def rows(self, cells: np.ndarray, order: int) -> pd.DataFrame:
        """Return the objects of some HEALPix cells: key, coord_ra, coord_dec and _healpix_29, sorted by key."""
        parts = []
        for name, product in self.objects.items():
            frame = product.rows_in(cells, order, ["objectId", "coord_ra", "coord_dec"])
            if shift := self.shift.get(name, 0.0):
                # towards the equator, so that no object is shifted across a pole
                dec = frame["coord_dec"]
                frame["coord_dec"] = dec - np.where(dec > 0, 1, -1) * shift / 3600
            parts.append(frame.assign(key=frame["objectId"].to_numpy(np.int64) * CODES + self.codes[name]))
        return pd.concat(parts, ignore_index=True).sort_values("key", ignore_index=True).drop(columns="objectId")

    def own(self, index: int) -> pd.DataFrame:
        """Return the objects of the partition with a given index."""
        return self.rows(np.array([self.cells[index]]), self.order)
