"""What the makers of a coadd's tiles share: the tiles, and the exposures that touch them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.instrument import Instrument
from romandask.model.settings import CoaddSettings, RenderSettings
from romandask.model.tiles import Tile
from romandask.products.images import ImageProduct
from romandask.stages.exposures import RenderExposure


@dataclass(frozen=True)
class TileBand:
    """A unit of a coadd: one tile in one band."""

    tile: Tile
    band: str
    members: np.ndarray
    """Rows of the exposures that touch the tile."""
    wcs: WCS


@dataclass(frozen=True)
class TileMaker:
    """Makes the units of a coadd; a way of making them is a subclass."""

    exposures: ImageProduct
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    """Rows of the exposures that touch a tile, by its number and band."""
    settings: CoaddSettings
    pixels: int
    """Side of a tile."""
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq and PSF of a unit, and what else the way of making it has."""
        raise NotImplementedError

    @property
    def source(self) -> RenderExposure:
        """What makes the exposures."""
        return source_of(self.exposures)

    @property
    def instrument(self) -> Instrument:
        """The instrument of the exposures."""
        return self.source.instrument

    def unit(self, index: int) -> TileBand:
        """Return the tile and band of a unit."""
        k, b = divmod(index, len(self.instrument.bands))
        band = self.instrument.bands[b]
        return TileBand(self.tiles[k], band, self.members[k, band], self.wcs(k))

    def header(self, tile: int) -> dict:
        """Return the FITS header of the WCS of a tile, by its number."""
        return self.tiles[tile].header(self.pixels, self.instrument.coadd_scale)

    def wcs(self, tile: int) -> WCS:
        """Return the WCS of a tile, by its number."""
        return WCS(self.header(tile))


def unit_of(tile: int, band: str, bands: tuple[str, ...]) -> int:
    """Return the number of the unit of a tile and band: of a tile one a band, in their order."""
    return tile * len(bands) + bands.index(band)


def source_of(exposures: ImageProduct) -> RenderExposure:
    """Return what makes exposures.

    Raises
    ------
    TypeError
        If they are not the product that `exposures()` returns.
    """
    if not isinstance(exposures.make, RenderExposure):
        raise TypeError(f"{exposures.stage} is not the product that exposures() returns")
    return exposures.make


def tile_maker(coadds: ImageProduct) -> TileMaker:
    """Return what makes the tiles of a coadd.

    Raises
    ------
    TypeError
        If it is not the product that `coadds()` returns.
    """
    if not isinstance(coadds.make, TileMaker):
        raise TypeError(f"{coadds.stage} is not the product that coadds() returns")
    return coadds.make
