"""The tiles of a coadd, the exposures that touch them, and what the ways of making them share."""

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
from romandask.stages.exposures.exposures import Exposures
from romandask.stages.truth.catalogs import TruthCatalogs


@dataclass(frozen=True)
class TileBand:
    """A unit of a coadd: one tile in one band."""

    tile: Tile
    band: str
    members: np.ndarray
    """Rows of the exposures that touch the tile."""
    wcs: WCS


@dataclass(frozen=True, kw_only=True)
class TileMaker:
    """Makes the units of a coadd; a way of making them is a subclass."""

    exposures: Exposures
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
    def seed(self) -> int:
        """Of the survey."""
        return self.exposures.renderer.seed

    @property
    def instrument(self) -> Instrument:
        """The instrument of the exposures."""
        return self.exposures.instrument

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


@dataclass(frozen=True, kw_only=True, repr=False)
class Coadds(ImageSet):
    """The coadds of one instrument: lazy images (tile, band, y, x), and what makes them."""

    maker: TileMaker

    @property
    def exposures(self) -> Exposures:
        """The exposures that they are made of; of an instrument that is drawn from its cadence never rendered."""
        return self.maker.exposures

    @property
    def instrument(self) -> Instrument:
        """The instrument."""
        return self.maker.instrument

    @property
    def truth(self) -> TruthCatalogs:
        """The truth under them."""
        return self.exposures.renderer.truth

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """The tiles."""
        return self.maker.tiles

    @property
    def pixels(self) -> int:
        """Pixels along a side of a tile."""
        return self.maker.pixels

    @property
    def settings(self) -> CoaddSettings:
        """The section `coadds` of the pipeline."""
        return self.maker.settings

    @property
    def footprints(self) -> np.ndarray:
        """(n, 4, 2) corners of the units, degrees."""
        side = self.settings.grid().side
        corners = np.stack([tile.corners(side) for tile in self.tiles])
        return np.repeat(corners, len(self.instrument.bands), axis=0)

    @property
    def image_shape(self) -> tuple[int, int]:
        """(ny, nx) of a tile."""
        return self.pixels, self.pixels

    @property
    def unit_bands(self) -> np.ndarray:
        """(n,) band of each unit."""
        return np.array(self.instrument.bands * len(self.tiles), object)

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Layers of cutouts beside the stored arrays: none."""
        return {}

    def index(self, tile: int, band: str) -> int:
        """Return the number of the unit of a tile and band."""
        return unit_of(tile, band, self.instrument.bands)

    def tile_band(self, index: int) -> TileBand:
        """Return the tile and band of a unit."""
        return self.maker.unit(index)

    def header(self, index: int) -> dict:
        """Return the FITS header of the WCS of a unit."""
        return self.maker.header(index // len(self.instrument.bands))

    def wcs(self, tile: int) -> WCS:
        """Return the WCS of a tile, by its number."""
        return self.maker.wcs(tile)

    def make_layers(
        self,
        index: int,
        wanted: Sequence[str],
        window: tuple[slice, slice],
        arrays: dict[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Return no layers: all are stored."""
        return {}

    def make_psfs(self, index: int, positions: np.ndarray, size: int) -> np.ndarray:
        """Raise NotImplementedError: PSF cutouts are those of exposures; `survey.psf` is that of a coadd."""
        raise NotImplementedError("PSF cutouts are those of exposures")
