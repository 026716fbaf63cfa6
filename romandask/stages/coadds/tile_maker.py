"""Tiles of a coadd, the exposures that touch them, and the common base of the methods that make coadds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.instrument import Instrument
from romandask.model.settings import CoaddSettings, RenderSettings
from romandask.model.tiles import Tile
from romandask.products.image_set import ImageSet
from romandask.products.mosaic import Mosaic
from romandask.stages.exposures.exposures import Exposures
from romandask.stages.truth.truth_catalogs import TruthCatalogs


@dataclass(frozen=True)
class TileBand:
    """One unit of a coadd: a tile in a band."""

    tile: Tile
    band: str
    members: np.ndarray
    """Rows in the pointings table of the exposures in the band that touch the tile."""
    wcs: WCS
    """WCS of the tile."""


@dataclass(frozen=True, kw_only=True)
class TileMaker:
    """Makes the units of a coadd. Each method (drizzling, warping, drawing) is a subclass."""

    exposures: Exposures
    """Exposures that the tiles are made from."""
    tiles: tuple[Tile, ...]
    members: dict[tuple[int, str], np.ndarray]
    """Rows in the pointings table of the exposures that touch a tile, by index of the tile and band."""
    settings: CoaddSettings
    pixels: int
    """Side of a tile, pixels."""
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq and psf of a unit, and the other arrays and tables of the method."""
        raise NotImplementedError

    @property
    def seed(self) -> int:
        """Seed of the survey."""
        return self.exposures.renderer.seed

    @property
    def instrument(self) -> Instrument:
        """Instrument of the exposures."""
        return self.exposures.instrument

    def unit(self, index: int) -> TileBand:
        """Return the tile and band of the unit with an index."""
        k, b = divmod(index, len(self.instrument.bands))
        band = self.instrument.bands[b]
        return TileBand(self.tiles[k], band, self.members[k, band], self.wcs(k))

    def header(self, tile: int) -> dict[str, Any]:
        """Return the FITS header with the WCS of the tile with an index."""
        return self.tiles[tile].header(self.pixels, self.instrument.coadd_scale)

    def wcs(self, tile: int) -> WCS:
        """Return the WCS of the tile with an index."""
        return WCS(self.header(tile))


@dataclass(frozen=True, kw_only=True, repr=False)
class Coadds(ImageSet):
    """The coadds of one instrument: lazy images with the dims (tile, band, y, x), and the object that makes them."""

    maker: TileMaker
    """Makes the units of the product."""

    @property
    def exposures(self) -> Exposures:
        """Exposures that the coadds are made from. They are never rendered if the coadds are drawn from a cadence."""
        return self.maker.exposures

    @property
    def instrument(self) -> Instrument:
        """Instrument of the exposures."""
        return self.maker.instrument

    @property
    def truth(self) -> TruthCatalogs:
        """Truth catalogs that the exposures show."""
        return self.exposures.renderer.truth

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """Tiles of the survey."""
        return self.maker.tiles

    @property
    def pixels(self) -> int:
        """Side of a tile, pixels."""
        return self.maker.pixels

    @property
    def settings(self) -> CoaddSettings:
        """The `coadds` section of the pipeline."""
        return self.maker.settings

    @property
    def footprints(self) -> np.ndarray:
        """Corners of the units, shape (n, 4, 2), degrees."""
        side = self.settings.grid().side
        corners = np.stack([tile.corners(side) for tile in self.tiles])
        return np.repeat(corners, len(self.instrument.bands), axis=0)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of a tile."""
        return self.pixels, self.pixels

    @property
    def unit_bands(self) -> np.ndarray:
        """Band of each unit, shape (n,)."""
        return np.array(self.instrument.bands * len(self.tiles), object)

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Layers of cutouts that are not stored: none."""
        return {}

    def index(self, tile: int, band: str, *patch: int) -> int:
        """Return the index of the unit of a tile (by index), a band and the row and column of a patch."""
        return self.product.layout.unit(tile, self.instrument.bands.index(band), *patch)

    def tile_image(self, tile: int, band: str) -> Mosaic:
        """Return a reader of windows of a tile (by index) in a band, across its patches."""
        return self.image(tile, self.instrument.bands.index(band))

    def tile_band(self, index: int) -> TileBand:
        """Return the tile and band of the unit with an index."""
        return self.maker.unit(index)

    def header(self, index: int) -> dict[str, Any]:
        """Return the FITS header with the WCS of the unit with an index."""
        return self.maker.header(index // len(self.instrument.bands))

    def wcs(self, tile: int) -> WCS:
        """Return the WCS of the tile with an index."""
        return self.maker.wcs(tile)

    def make_layers(
        self,
        index: int,
        wanted: Sequence[str],
        window: tuple[slice, slice],
        arrays: dict[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return no layers, because all layers of coadds are stored."""
        return {}

    def make_psfs(self, index: int, positions: np.ndarray, size: int) -> np.ndarray:
        """Raise NotImplementedError: only exposures have PSF cutouts; for coadds see `Survey.psf`."""
        raise NotImplementedError("PSF cutouts are those of exposures")
