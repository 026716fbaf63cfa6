"""Patches of a coadd, the exposures that touch them, and the common base of the methods that make coadds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.instrument import Instrument
from romandask.model.settings import CoaddSettings, RenderSettings
from romandask.model.tiles import PatchGrid, Tile
from romandask.products.image_set import ImageSet
from romandask.products.mosaic import Mosaic
from romandask.stages.exposures.exposures import Exposures
from romandask.stages.truth.truth_catalogs import TruthCatalogs


@dataclass(frozen=True)
class Members:
    """Exposures that touch the patches of a survey's tiles: rows in the pointings table, in ascending order."""

    rows: np.ndarray
    """Rows of the exposures of one unit after another."""
    limits: np.ndarray
    """Where the rows of each unit begin in `rows`, and where the last end; one more than there are units."""

    def __len__(self) -> int:
        return len(self.limits) - 1

    def __getitem__(self, unit: int) -> np.ndarray:
        """Return the rows of the exposures of a unit."""
        if not 0 <= unit < len(self):
            raise IndexError(unit)
        return self.rows[self.limits[unit] : self.limits[unit + 1]]

    @property
    def counts(self) -> np.ndarray:
        """Number of exposures of each unit."""
        return np.diff(self.limits)

    def of(self, units: Iterable[int]) -> np.ndarray:
        """Return the rows of the exposures of any of some units."""
        return np.unique(np.concatenate([self[unit] for unit in units]))


@dataclass(frozen=True)
class Patch:
    """One unit of a coadd: a patch of a tile in a band."""

    tile: Tile
    band: str
    row: int
    """Row of the patch on the tile."""
    column: int
    """Column of the patch on the tile."""
    members: np.ndarray
    """Rows in the pointings table of the exposures in the band that touch the patch."""
    window: tuple[slice, slice]
    """Rows and columns of the tile that the patch covers."""
    tile_header: dict[str, Any]
    """FITS header with the WCS of the tile."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the patch."""
        rows, columns = self.window
        return rows.stop - rows.start, columns.stop - columns.start

    @property
    def corner(self) -> tuple[int, int]:
        """Row and column on the tile of the first pixel of the patch."""
        return self.window[0].start, self.window[1].start

    @property
    def wcs(self) -> WCS:
        """WCS of the patch as an image of its own."""
        y, x = self.corner
        header = self.tile_header
        return WCS({**header, "CRPIX1": header["CRPIX1"] - x, "CRPIX2": header["CRPIX2"] - y})

    @property
    def centre(self) -> tuple[float, float]:
        """Right ascension and declination of the centre of the patch, degrees."""
        ny, nx = self.shape
        ra, dec = self.wcs.all_pix2world((nx - 1) / 2, (ny - 1) / 2, 0)
        return float(ra), float(dec)

    @property
    def footprint(self) -> np.ndarray:
        """Corners of the patch, shape (4, 2), degrees."""
        return patch_corners(self.wcs, self.shape)


def patch_corners(wcs: WCS, shape: tuple[int, int], margin: float = 0.0) -> np.ndarray:
    """Return the corners, shape (4, 2), degrees, of an image, or of one wider by a margin, pixels, on each edge."""
    ny, nx = shape
    low, right, top = -0.5 - margin, nx - 0.5 + margin, ny - 0.5 + margin
    return np.stack(wcs.all_pix2world([low, right, right, low], [low, low, top, top], 0), axis=1)


@dataclass(frozen=True, kw_only=True)
class TileMaker:
    """Makes the units of a coadd. Each method (drizzling, warping, drawing) is a subclass."""

    exposures: Exposures
    """Exposures that the tiles are made from."""
    tiles: tuple[Tile, ...]
    patches: PatchGrid
    """Division of a tile into patches."""
    members: Members
    """Exposures that touch the patch of each unit."""
    settings: CoaddSettings
    render: RenderSettings

    def __call__(self, index: int) -> dict[str, Any]:
        """Return image, weight, noise, nimages, dq and psf of a unit, and the other arrays and tables of the method."""
        raise NotImplementedError

    @property
    def pixels(self) -> int:
        """Side of a tile, pixels."""
        return self.patches.pixels

    @property
    def seed(self) -> int:
        """Seed of the survey."""
        return self.exposures.renderer.seed

    @property
    def instrument(self) -> Instrument:
        """Instrument of the exposures."""
        return self.exposures.instrument

    def unit(self, index: int) -> Patch:
        """Return the patch of the unit with an index."""
        count = self.patches.count
        lengths = (len(self.tiles), len(self.instrument.bands), count, count)
        k, b, row, column = (int(value) for value in np.unravel_index(index, lengths))
        return Patch(
            tile=self.tiles[k],
            band=self.instrument.bands[b],
            row=row,
            column=column,
            members=self.members[index],
            window=self.patches.window(row, column),
            tile_header=self.header(k),
        )

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
        """Corners of the images, a tile in each band, shape (n, 4, 2), degrees."""
        side = self.settings.grid().side
        corners = np.stack([tile.corners(side) for tile in self.tiles])
        return np.repeat(corners, len(self.instrument.bands), axis=0)

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of the images: tile and band."""
        return tuple(f"{tile.name}-{band}" for tile in self.tiles for band in self.instrument.bands)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of a tile."""
        return self.pixels, self.pixels

    @property
    def image_bands(self) -> np.ndarray:
        """Band of each image, shape (n,)."""
        return np.array(self.instrument.bands * len(self.tiles), object)

    @property
    def extra_layers(self) -> dict[str, tuple[str, str, str]]:
        """Layers of cutouts that are not stored: none."""
        return {}

    @property
    def patches(self) -> PatchGrid:
        """Division of a tile into patches."""
        return self.maker.patches

    def index(self, tile: int, band: str, row: int, column: int) -> int:
        """Return the index of the unit of a tile (by index), a band, and the row and column of a patch."""
        return self.product.layout.unit(tile, self.instrument.bands.index(band), row, column)

    def units_of(self, tile: int, band: str) -> list[int]:
        """Return the indices of the units, the patches, of a tile (by index) in a band."""
        first, count = self.index(tile, band, 0, 0), self.patches.count**2
        return list(range(first, first + count))

    def tile_image(self, tile: int, band: str) -> Mosaic:
        """Return a reader of windows of a tile (by index) in a band, across its patches."""
        return self.image(tile, self.instrument.bands.index(band))

    def read(self, tile: int, band: str, names: Sequence[str], window: tuple[slice, ...] = ()) -> dict[str, np.ndarray]:
        """Return a window of arrays of a tile (by index) in a band, by name; see `Mosaic`."""
        image = self.tile_image(tile, band)
        return {name: image(name, window) for name in names}

    def has_tile(self, tile: int, band: str) -> bool:
        """Return whether all patches of a tile (by index) in a band are stored."""
        return all(self.has(unit) for unit in self.units_of(tile, band))

    def tile_members(self, tile: int, band: str) -> np.ndarray:
        """Return the rows in the pointings table of the exposures in a band that touch a tile (by index)."""
        return self.maker.members.of(self.units_of(tile, band))

    def tile_psf(self, tile: int, band: str) -> np.ndarray:
        """Return the mean of the PSFs of the patches of a tile (by index) in a band; 0 if there is no exposure."""
        psfs = [self.load(unit, ("psf",))["psf"] for unit in self.units_of(tile, band)]
        covered = [psf for psf in psfs if psf.any()]
        return np.mean(covered, axis=0) if covered else psfs[0]

    def image_place(self, image: int) -> tuple[int, str]:
        """Return the tile (by index) and the band of an image."""
        tile, band = divmod(image, len(self.instrument.bands))
        return tile, self.instrument.bands[band]

    def patch(self, index: int) -> Patch:
        """Return the patch of the unit with an index."""
        return self.maker.unit(index)

    def header(self, image: int) -> dict[str, Any]:
        """Return the FITS header with the WCS of an image."""
        return self.maker.header(self.image_place(image)[0])

    def load_image(self, image: int, names: tuple[str, ...], window: tuple[slice, ...] = ()) -> dict[str, np.ndarray]:
        """Return a window of arrays of an image, by name."""
        return self.read(*self.image_place(image), names, window)

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
