"""Truth catalogs of galaxies and stars, and the selection of objects near a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from romandask.kernels.rendering.scene import Truth, bind
from romandask.kernels.universe.dust import Dust
from romandask.model.sky import cells_in_cone, unit_vectors
from romandask.model.spectra import SpectrumLibrary
from romandask.products.images import ImageProduct
from romandask.products.tables import TableProduct

NEAR_ORDER = 11
"""HEALPix order of the cells, 1.7 arcmin wide, by which rows near a position are selected."""


@dataclass(frozen=True, kw_only=True)
class TruthCatalogs:
    """The truth catalogs, and the spectra that they refer to."""

    galaxies: TableProduct
    stars: TableProduct
    quarantine: TableProduct
    """Quarantined rows of source catalogs."""
    structure: ImageProduct | None
    """Matter and lensing fields of a generated universe; None for source catalogs."""
    ingested: TableProduct | None
    """Rows of source catalogs in the normal form; None for a generated universe."""
    library: SpectrumLibrary
    """Spectra that the columns `*_sed` refer to by index."""
    edges: tuple[float, ...]
    """Rest-frame edges of the bins of top-hat spectra, nm; empty if no galaxy has a top-hat spectrum."""
    internal_frame: str
    """Frame in which the internal dust of galaxies acts, "rest" or "observed"."""

    def near(self, ra: float, dec: float, radius: float, stars_radius: float) -> Truth:
        """Return the objects around a position, with their spectra.

        Reads only the parts of the partitions that the cones need. Objects of the same HEALPix cells of order
        `NEAR_ORDER` are included, so some lie outside the cones.

        Parameters
        ----------
        ra, dec : float, degrees
            Position.
        radius, stars_radius : float, degrees
            Radii of the cones that contain the galaxies and the stars.
        """
        galaxies = _rows_near(self.galaxies, ra, dec, radius)
        stars = _rows_near(self.stars, ra, dec, stars_radius)
        return bind(galaxies, stars, self.library, self.edges, self.internal_frame)

    def brief(self, ra: float, dec: float, radius: float, bands: Sequence[str]) -> pd.DataFrame:
        """Return id, star, ra, dec, redshift and flux_<band> (nJy) of the galaxies and stars around a cone.

        Parameters
        ----------
        ra, dec, radius : float, degrees
            Centre and radius of the cone; some objects lie outside, as for `near`.
        bands : sequence of str
            Bands of the fluxes.
        """
        fluxes = [f"flux_{band}" for band in bands]
        galaxies = _rows_near(self.galaxies, ra, dec, radius, ["galaxy_id", "ra", "dec", "redshift", *fluxes])
        stars = _rows_near(self.stars, ra, dec, radius, ["id", "ra", "dec", *fluxes])
        galaxies = galaxies.rename(columns={"galaxy_id": "id"}).assign(star=False)
        both = [galaxies, stars.assign(star=True, redshift=0.0)]
        objects = pd.concat([part for part in both if len(part)] or both, ignore_index=True)
        return objects[["id", "star", "ra", "dec", "redshift", *fluxes]]

    def milky_way(self, at: np.ndarray, ra: float, dec: float, radius: float) -> Dust:
        """Return the dust of the Milky Way at some positions, taken from the nearest galaxy.

        Parameters
        ----------
        at : ndarray, shape (n, 3)
            Positions, as unit vectors.
        ra, dec, radius : float, degrees
            Cone that contains the positions, and around which galaxies are searched.

        Returns
        -------
        Dust
            Dust at each position; A_v is NaN if there is no galaxy around the cone.
        """
        rows = _rows_near(self.galaxies, ra, dec, radius, ["ra", "dec", "MW_av", "MW_rv"])
        if not len(rows):
            return Dust(np.full(len(at), np.nan), np.full(len(at), 3.1))
        _, near = cKDTree(unit_vectors(rows["ra"].to_numpy(), rows["dec"].to_numpy())).query(at)
        return Dust(rows["MW_av"].to_numpy(float)[near], rows["MW_rv"].to_numpy(float)[near])

    def inputs(self, ra: float, dec: float, radius: float, stars_radius: float) -> tuple[tuple[str, str], ...]:
        """Return the (stage, unit) that `near` reads for the same arguments."""
        return tuple(
            (product.stage, product.names[index])
            for product, reach in ((self.galaxies, radius), (self.stars, stars_radius))
            for index in product.touching(cells_in_cone(ra, dec, reach, product.order or 0))
        )


def _rows_near(
    product: TableProduct, ra: float, dec: float, radius: float, wanted: list[str] | None = None
) -> pd.DataFrame:
    """Return the rows in the HEALPix cells that touch a cone, sorted by cell.

    `wanted` are the columns to return; by default all except fluxes and extinctions.
    """
    order = max(product.order or 0, NEAR_ORDER)
    columns = wanted or [name for name in product.schema.names if not name.startswith(("flux_", "dust_", "lsst_flux_"))]
    return product.rows_in(cells_in_cone(ra, dec, radius, order), order, columns)
